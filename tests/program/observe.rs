//! Observations as a program in Rust has them: `examples/observe.rs`, beside a rig whose devices come and go.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::path::Path;
use std::process::Command;

use crate::support::Place;

/// The fields of a topic in a line: state, age, shape, numbers.
fn fields<'a>(line: &'a str, topic: &str) -> Vec<&'a str> {
    let part = line.split("; ").find_map(|part| part.strip_prefix(topic)?.strip_prefix(": ")).expect("its part");
    // A device that is being opened again is "plugged in, not running".
    part.strip_prefix("plugged in, ").unwrap_or(part).splitn(4, ", ").collect()
}

/// The mean of a picture, or the numbers of a vector.
fn numbers(field: &str) -> Vec<f64> {
    let list = field.trim_start_matches("mean ").trim_matches(['[', ']']);
    list.split(", ").map(|number| number.parse().expect("a number")).collect()
}

#[test]
fn the_example_prints_the_numbers_of_each_topic_and_zeros_for_absent_ones() {
    let place = Place::new();
    // 240 observations are 8 s at least: whenever they begin, the two are there for some of them, and not for others.
    let scenario = "repeat = \"8s\"\n[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\n\
        name = \"motor_state\"\n[[event]]\nat = \"4s\"\nunplug = \"tactile_tip\"\n[[event]]\nat = \"4s\"\n\
        unplug = \"motor_state\"\n[[event]]\nat = \"6s\"\nplug = \"tactile_tip\"\n[[event]]\nat = \"6s\"\nplug = \"motor_state\"\n";
    place.write("sim.toml", scenario);
    // Wider than the time between two frames: see the test of the same in Python.
    let wide = ["--sim", "sim.toml", "--headless", "--json", "--window", "50ms"];
    let running = place.start(&wide, "\"mask\":\"0x07\"");
    let [wrist, tactile, motor] = ["/rapid/camera/wrist", "/rapid/camera/tactile", "/rapid/serial/motor"];
    let example = Path::new(env!("CARGO_BIN_EXE_rapid")).with_file_name("examples").join("observe");
    let observe = |arguments: &[&str]| {
        Command::new(&example)
            .args(arguments)
            .env("RAPID_INSTANCE", &place.instance)
            .output()
            .expect("the example runs")
    };
    let shapes = [(wrist, "480x640x3"), (tactile, "240x320x3"), (motor, "3")];
    let named = shapes.map(|(topic, shape)| format!("{topic}={shape}"));
    let ended = observe(&["240", &named[0], &named[1], &named[2]]);
    // Another shape than the samples have is refused by name.
    let refused = observe(&["240", &format!("{wrist}=48x64x3")]);
    drop(running);
    assert!(ended.status.success(), "{ended:?}");
    let errors = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && errors.contains("/rapid/camera/wrist: its samples are 480x640x3"), "{errors}");

    let text = String::from_utf8_lossy(&ended.stdout);
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 240, "{text}");
    let ticks: Vec<u64> = lines
        .iter()
        .map(|line| line.split(' ').nth(1).and_then(|number| number.parse().ok()).expect("a number"))
        .collect();
    assert!(
        lines.iter().all(|line| line.starts_with("tick ")) && ticks.windows(2).all(|pair| pair[0] < pair[1]),
        "{text}"
    );
    for (topic, shape) in shapes {
        assert!(lines.iter().all(|line| fields(line, topic)[2] == shape), "{topic}: {text}");
    }
    // What is valid has numbers of its own, with an age.
    let is_valid = |line: &str, topic: &str| {
        let fields = fields(line, topic);
        fields[0] == "valid" && fields[1].ends_with(" ms") && numbers(fields[3]).iter().any(|number| *number != 0.0)
    };
    let whole = |line: &&&str| {
        line.contains(" mask 0x07; ") && [wrist, tactile, motor].iter().all(|topic| is_valid(line, topic))
    };
    assert!(lines.iter().any(|line| whole(&line)), "{text}");
    let value = |line: &&str, topic: &str| fields(line, topic)[3].to_owned();
    let seen: std::collections::BTreeSet<_> = lines.iter().map(|line| value(line, motor)).collect();
    assert!(seen.len() > 5, "the numbers change with the samples: {seen:?}");
    // What is unplugged is zeros, beside what is not.
    let zeros = [
        (tactile, ["absent", "no sample", "240x320x3", "mean 0.000"]),
        (motor, ["absent", "no sample", "3", "[0.000, 0.000, 0.000]"]),
    ];
    let out = |line: &&&str| {
        line.contains(" mask 0x01; ") && zeros.iter().all(|(topic, expected)| fields(line, topic) == expected)
    };
    let out: Vec<_> = lines.iter().filter(out).collect();
    assert!(out.iter().any(|line| is_valid(line, wrist)), "{text}");
}
