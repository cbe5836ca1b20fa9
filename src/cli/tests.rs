//! What is printed for what is typed.

use insta::assert_snapshot;

use super::*;

/// What is printed for `rapid WORDS`, at the width of a usual terminal.
fn printed(words: &str) -> String {
    let typed = std::iter::once("rapid").chain(words.split_whitespace()).map(OsString::from);
    match Cli::read(typed) {
        Ok(cli) => panic!("understood: {cli:?}"),
        Err(error) => error.to_string(),
    }
}

#[test]
fn help() {
    for words in ["-h", "--help"] {
        assert_snapshot!(format!("help_{}", words.trim_matches('-')), printed(words));
    }
    let commands: Vec<_> = Cli::command().get_subcommands().map(|command| command.get_name().to_owned()).collect();
    for command in commands {
        // What it measures is said one word further.
        let words = if command == "calibrate" { "calibrate latency" } else { command.as_str() };
        let help = printed(&format!("{words} --help"));
        assert!(help.lines().count() <= 40, "{help}");
        assert_snapshot!(format!("help_of_{command}"), help);
    }
}

#[test]
fn the_command_is_well_formed() {
    Cli::command().debug_assert();
}

#[test]
fn options_stand_before_or_after_a_command_or_it_is_said_where() {
    let read = |words: &str| Cli::read(words.split_whitespace().map(OsString::from)).unwrap();
    assert!(read("rapid --json check").global.json && read("rapid check --json").global.json);
    assert!(read("rapid --sim --json devices").simulation.sim.is_some());
    let Some(Command::Devices { simulation, .. }) = read("rapid devices --sim x.toml").command else { panic!() };
    assert_eq!(simulation.sim, Some(Some("x.toml".into())));
    for (words, expected) in [
        ("--headless replay a.mcap", "write it after: rapid replay FILE --headless"),
        ("replay a.mcap --infer --record", "--record is an option of a run, and --infer compares"),
        ("replay a.mcap --tolerance 1", "--infer"),
        ("--record inspect a.mcap", "`rapid inspect` runs nothing"),
        ("--sim devices", "write `rapid devices --sim`"),
        ("--sim mask", "leave --sim out"),
        ("--sim --headless play.toml", "right after --sim (rapid --sim play.toml)"),
        ("a.mcap", "rapid inspect a.mcap"),
        ("devces", "'devices'"),
    ] {
        let said = printed(words);
        assert!(said.contains(expected), "{words}: {said}");
    }
}

#[test]
fn quantities_say_how_they_are_written() {
    for (words, expected) in [
        ("--duration 30", "a number and a unit, for example 30s"),
        ("--duration 0s", "longer than nothing"),
        ("--window 1h", "between 1ms and 10s"),
        ("--window 25", "25ms"),
        ("--rate abc", "a number, for example 30"),
        ("--rate 0", "between 0.1 and 1000 Hz"),
        ("--tag soft", "finger=soft"),
        ("replay a.mcap --infer --tolerance=-1", "a number from 0 on"),
        ("replay a.mcap --infer --tolerance NaN", "a number from 0 on"),
        ("eval --trials 0", "at least 1"),
        ("artifacts --install --to x", "cannot be used with '--to"),
        ("--tag a=1 --tag b=1 --tag a=2", "--tag a is given more than once"),
        ("replay x.mcap --record --tag a=1 --tag a=1", "--tag a is given more than once"),
        ("--instance a/b", "letters, digits and dashes"),
    ] {
        let said = printed(words);
        assert!(said.contains(expected), "{words}: {said}");
    }
}
