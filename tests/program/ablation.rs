//! A comparison of configurations: what is recorded, what counts, what is next.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use crate::support::{self, Episode, Place, events};
use serde_json::Value;

const MODULES: &str = "
[module.get]
slot = \"tip\"
tags = [\"finger=tactile\"]
devices = [\"tactile_tip\"]

[module.soft_tip]
slot = \"tip\"
tags = [\"finger=soft\"]
";

/// The rig of the repository, with modules; in the scenario only the camera at the wrist is there.
fn place() -> Place {
    let place = Place::new();
    place.write("devices.toml", &format!("{}{MODULES}", include_str!("../../devices.toml")));
    place.write("vision.toml", "[[device]]\nname = \"cam_wrist\"\n");
    place.write("both.toml", "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n");
    place
}

/// Records half a second of an episode whose sensors run when it begins; gives its file.
fn record(place: &Place, scenario: &str, more: &[&str]) -> String {
    let before = place.files("episodes");
    let run = ["--json", "--headless", "--sim", scenario, "--record", "--duration", "500ms", "--task", "t"];
    let output = place.run(&[&run[..], more].concat());
    let code = support::recorded_code(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(output.status.code(), code, "{}", String::from_utf8_lossy(&output.stderr));
    place.files("episodes").into_iter().find(|name| !before.contains(name)).expect("an episode")
}

fn ablation(place: &Place, more: &[&str]) -> Vec<Value> {
    let plan =
        ["ablation", "--json", "--finger", "soft,tactile", "--modality", "vision,vision+tactile", "--episodes", "1"];
    let output = place.run(&[&plan[..], more].concat());
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    events(&String::from_utf8_lossy(&output.stdout))
}

fn counts(printed: &[Value]) -> Vec<u64> {
    let configurations = printed.iter().filter(|line| line["event"] == "configuration");
    configurations.map(|line| line["episodes"].as_u64().expect("a count")).collect()
}

#[test]
fn episodes_count_for_their_declared_configuration() {
    let place = place();
    let none = ablation(&place, &[]);
    assert_eq!(counts(&none), [0, 0, 0, 0]);
    let next = none.last().expect("a line");
    assert_eq!(next["command"], "rapid --record --out episodes --module soft_tip");
    assert_eq!(
        (&next["plug"], &next["leave_out"]),
        (&serde_json::json!(["cam_wrist"]), &serde_json::json!(["tactile_tip"]))
    );

    let soft = record(&place, "vision.toml", &["--module", "soft_tip"]);
    let episode = Episode::read(&place.path("episodes").join(&soft));
    let tags: Value = serde_json::from_str(episode.value("rapid", "tags")).expect("JSON");
    assert_eq!(tags["finger"], "soft");
    let configuration: Value = serde_json::from_str(episode.value("rapid", "configuration")).expect("JSON");
    assert_eq!(configuration["modules"], serde_json::json!(["soft_tip"]));
    assert_eq!(configuration["present"], serde_json::json!(["cam_wrist"]));
    let any = ["--count", "any"];
    assert_eq!(counts(&ablation(&place, &any)), [1, 0, 0, 0]);
    // The module whose sensor is there is mounted without being named.
    let tactile = record(&place, "both.toml", &[]);
    let episode = Episode::read(&place.path("episodes").join(&tactile));
    let tags: Value = serde_json::from_str(episode.value("rapid", "tags")).expect("JSON");
    assert_eq!(tags["finger"], "tactile");
    let printed = ablation(&place, &any);
    assert_eq!(counts(&printed), [1, 0, 0, 1]);
    assert_eq!(printed.last().expect("a line")["modalities"], "vision+tactile");

    let other = record(&place, "vision.toml", &["--tag", "finger=hard"]);
    assert!(soft != other && tactile != other);
    let printed = ablation(&place, &any);
    let left_out = printed.iter().find(|line| line["event"] == "not_counted").expect("a line");
    assert_eq!(left_out["episodes"]["of no finger of the plan"], 1);
    let printed = ablation(&place, &["--count", "any", "--task", "another"]);
    assert_eq!(counts(&printed), [0, 0, 0, 0]);
}

#[test]
fn impossible_values_are_rejected_with_the_valid_ones() {
    let place = place();
    let refused = |arguments: &[&str]| {
        let output = place.run(arguments);
        assert_eq!(output.status.code(), Some(2), "{}", String::from_utf8_lossy(&output.stdout));
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(refused(&["ablation"]).contains("--finger A,B"));
    assert!(refused(&["ablation", "--finger", "a", "--modality", "smell"]).contains("\"smell\""));
    assert!(refused(&["ablation", "--finger", "a", "--modality", "a", "--episodes", "0"]).contains("1 or more"));
    assert!(refused(&["--headless", "--sim", "--module", "soft_tpi"]).contains("did you mean \"soft_tip\"?"));
    let both = refused(&["--headless", "--sim", "--module", "soft_tip", "--module", "get"]);
    assert!(both.contains("both sit in the slot tip"), "{both}");
    place.write("ablation.toml", "fingers = []\nmodalities = [\"vision\"]\n");
    assert!(refused(&["ablation"]).contains("ablation.toml:1"));
    place.write("ablation.toml", "fingers = [\"soft\"]\nmodalities = [\"vision\"]\nepisodes = 2\n");
    let output = place.run(&["ablation"]);
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(
        printed.contains("soft")
            && printed.contains("0 of 2  2 to record")
            && printed.contains("Next: soft with vision"),
        "{printed}"
    );
    // Files that are not episodes are reported and not counted.
    std::fs::create_dir(place.path("episodes")).expect("folder");
    place.write("episodes/x.mcap", "not an episode");
    let output = place.run(&["ablation"]);
    assert!(String::from_utf8_lossy(&output.stdout).contains("not counted: 1 that cannot be read"));
}
