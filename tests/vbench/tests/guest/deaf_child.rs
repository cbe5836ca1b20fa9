//! Programs that ignore SIGTERM, crash or flood their stderr: the mask continues as if nothing were.

use vbench::check::ended;
use vbench::deaf::{Span, figures, rhythm, scenario};
use vbench::recording::falls;

#[test]
fn misbehaving_programs_do_not_delay_the_mask() {
    let outcome = scenario().run().unwrap_or_else(|error| panic!("{error}"));
    ended(&outcome);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());

    for span in [Span::Idle, Span::Prompt, Span::Deaf, Span::Crashing, Span::Flooding] {
        let rhythm = rhythm(&outcome, span).expect("the sampler saw it");
        println!("{span:?}: {rhythm:?}");
        assert!(
            !outcome.is_virtual || rhythm.longest_ms < 3.0,
            "{span:?}: published every 2 ms, seen every 0.5: {rhythm:?}"
        );
        assert_eq!(rhythm.silent_tenths, 0, "{span:?}: {rhythm:?}");
    }
    // `make bench` measures by the same run.
    for figure in figures(&outcome) {
        assert!(figure.value.is_some(), "not measured: {figure}");
    }
    let edges = outcome.episode().unwrap_or_else(|error| panic!("{error}")).mask_edges();
    for (device, bit) in [(0, 0), (1, 1)] {
        let unplugged = outcome.actions("unplug", device)[0].real_ns;
        let fallen = falls(&edges, bit);
        assert_eq!(fallen.len(), 1, "{fallen:?}");
        assert!(fallen[0] >= unplugged, "the bit of device {device} fell before it was unplugged");
    }

    let reports = |words: &str| {
        let printed = |line: &&serde_json::Value| line["text"].as_str().is_some_and(|text| text.contains(words));
        outcome.rapid.iter().filter(printed).count()
    };
    assert_eq!(reports("prompt: reads /dev/ttyACM"), 1, "it is given the serial line");
    assert_eq!(reports("deaf: reads /dev/bus/usb/"), 1, "it is given the USB device");
    assert_eq!(reports("was killed"), 1, "only the deaf one");
    let absent = |line: &&serde_json::Value| line["device"] == "deaf" && line["state"] == "absent";
    let killed = |line: &&serde_json::Value| line["text"].as_str().is_some_and(|text| text.contains("was killed"));
    let stamp = |line: Option<&serde_json::Value>| line.and_then(|line| line["stamp"].as_u64()).expect("a stamp");
    let (absent, killed) = (stamp(outcome.rapid.iter().find(absent)), stamp(outcome.rapid.iter().find(killed)));
    assert!(killed >= absent + 5_000_000_000, "the bit goes at once, the program after its 5 s");

    let states = |device: &str| {
        let of_it = |line: &&serde_json::Value| line["device"] == device && line["event"] == "state";
        let states = outcome.rapid.iter().filter(of_it).filter_map(|line| line["state"].as_str());
        states.map(str::to_owned).collect::<Vec<_>>()
    };
    // After the sixth it has failed, if the recording lasts as long.
    let mut crashes = ["opening", "streaming", "backoff"].repeat(6);
    crashes[17] = "failed";
    assert!(
        crashes.starts_with(&states("crashing").iter().map(String::as_str).collect::<Vec<_>>()),
        "{:?}",
        states("crashing")
    );
    assert!(reports("crashing: Error: \"crashes after 50 samples") >= 5);
    assert_eq!(states("flooding"), ["opening", "streaming"], "it continues");
    assert!(reports("flooding: prints too much") > 0);
}
