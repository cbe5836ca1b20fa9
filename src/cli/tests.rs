//! Help texts, and errors of the command line.

use insta::assert_snapshot;

use super::*;

fn read(words: &str) -> Result<Cli, clap::Error> {
    Cli::read(std::iter::once("rapid").chain(words.split_whitespace()).map(OsString::from))
}

/// What is printed for `rapid WORDS`, which is help or an error.
fn printed(words: &str) -> String {
    match read(words) {
        Ok(cli) => panic!("accepted: {cli:?}"),
        Err(error) => error.to_string(),
    }
}

/// Each command, with the words that call it.
fn commands(words: &str, command: clap::Command) -> Vec<(String, clap::Command)> {
    let subcommands = command.get_subcommands().filter(|command| command.get_name() != "help");
    let of = |sub: &clap::Command| commands(&format!("{words} {}", sub.get_name()), sub.clone());
    let mut all: Vec<_> = subcommands.flat_map(of).collect();
    all.push((words.trim().to_owned(), command));
    all
}

#[test]
fn short_help_is_short_and_long_help_has_examples() {
    let mut grammar = Cli::grammar();
    grammar.build();
    for (words, command) in commands("", grammar) {
        let name = format!("rapid {words}").trim().replace(' ', "-");
        let (short, long) = (printed(&format!("{words} -h")), printed(&format!("{words} --help")));
        let narrow = command.term_width(80).render_help().to_string();
        assert!(short.lines().count() <= 40 && narrow.lines().count() <= 40, "{words}:\n{narrow}");
        assert!(long.contains("Examples:"), "{words}: {long}");
        assert_snapshot!(format!("{name}-short"), short);
        assert_snapshot!(format!("{name}-long"), long);
    }
}

/// An argument with a value that is accepted, after a space.
fn word(argument: &clap::Arg) -> String {
    let option = argument.get_long().map(|name| format!(" --{name}")).unwrap_or_default();
    let values = argument.get_possible_values();
    format!("{option} {}", values.first().map_or("bash", |value| value.get_name()))
}

#[test]
fn a_general_option_is_shown_exactly_where_it_is_accepted_and_has_an_effect() {
    let general = [("sim", "--sim=task"), ("config", "--config=x"), ("json", "--json"), ("instance", "--instance=x")];
    let mut grammar = Cli::grammar();
    grammar.build();
    for (words, command) in commands("", grammar).into_iter().filter(|(words, _)| !words.is_empty()) {
        let name = words.split(' ').next().unwrap();
        let help = printed(&format!("{words} --help"));
        let positional: String = command.get_arguments().filter(|value| value.is_required_set()).map(word).collect();
        for (option, argument) in general {
            let known = general_options(name).contains(&option);
            assert_eq!(help.contains(&format!("--{option}")), known, "{words} --{option}");
            if command.is_subcommand_required_set() {
                continue;
            }
            for words in [format!("{argument} {words}{positional}"), format!("{words}{positional} {argument}")] {
                match read(&words) {
                    Ok(_) => assert!(known, "accepted: {words}"),
                    Err(error) => {
                        assert!(!known && error.exit_code() == 2, "{words}: {error}");
                        let fix = format!("--{option} has no effect on `rapid {name}`: leave it out");
                        assert!(error.to_string().contains(&fix), "{words}: {error}");
                    }
                }
            }
        }
    }
}

#[test]
fn a_renamed_option_is_still_accepted_by_its_old_name() {
    for option in ["--ignore-missing", "--go-on"] {
        assert!(read(&format!("--infer --sim task {option}")).unwrap().policy.ignore_missing);
        assert!(printed(option).contains("--infer"), "{option} needs --infer");
    }
    assert!(!printed("--help").contains("go-on"));
}

#[test]
fn help_of_a_command_is_reached_both_ways() {
    assert_eq!(printed("help episode label"), printed("episode label --help"));
    assert_eq!(printed("help"), printed("--help"));
}

#[test]
fn the_command_is_well_formed() {
    Cli::grammar().debug_assert();
}

#[test]
fn options_before_or_after_a_command_parse_or_the_error_names_the_position() {
    let global = |words: &str| read(words).unwrap().global;
    assert!(global("--json check").json && global("check --json").json);
    assert!(global("--sim --json devices").sim.is_some());
    assert_eq!(global("devices --sim x.toml").sim, Some(Some("x.toml".into())));
    assert_eq!(global("calibrate latency --sim").sim, Some(None));
    for (words, expected) in [
        ("--headless replay a.mcap", "write it after: rapid replay FILE --headless"),
        ("replay a.mcap --infer --record", "--record is an option of a run, and --infer compares"),
        ("replay a.mcap --tolerance 1", "--infer"),
        ("--record inspect a.mcap", "`rapid inspect` starts no run"),
        ("inspect a.mcap --record", "--record is an option of a run"),
        ("--sim task --expert --record --duration 3s", "--duration"),
        ("--sim devices", "write `rapid devices --sim`"),
        ("--sim mask", "leave --sim out"),
        ("--sim --headless play.toml", "right after --sim (rapid --sim play.toml)"),
        ("a.mcap", "rapid inspect a.mcap"),
        ("devces", "'devices'"),
        ("--sim --tour --headless", "--tour needs the monitor, which --headless does not open"),
        ("replay a.mcap --utc --headless", "--utc needs the monitor, which --headless does not open"),
        ("--infer --sim task --mouse", "--mouse needs the monitor, which --infer opens only with --monitor"),
        ("--sim --seed 3", "--seed only affects `--sim task` and a policy"),
        ("--sim --headless --seed 3", "--seed only affects `--sim task` and a policy"),
    ] {
        let message = printed(words);
        assert!(message.contains(expected), "{words}: {message}");
    }
}

#[test]
fn an_option_that_has_an_effect_is_accepted() {
    for words in [
        "--infer --monitor --sim task --mouse",
        "--sim task --seed 3 --record --expert",
        "--infer x --seed 3",
        "--sim --tour --utc",
        "replay a.mcap --mouse",
        "monitor --utc",
        "eval --seed 4",
    ] {
        read(words).unwrap_or_else(|error| panic!("{words}: {error}"));
    }
}

#[test]
fn an_error_in_a_quantity_shows_how_it_is_written() {
    for (words, expected) in [
        ("--duration 30", "a number and a unit, for example 30s"),
        ("--duration 0s", "longer than 0s"),
        ("--window 1h", "between 1ms and 10s"),
        ("--window 25", "25ms"),
        ("--rate abc", "a number, for example 30"),
        ("--rate 0", "between 0.1 and 1000 Hz"),
        ("--tag soft", "finger=soft"),
        ("--task=", "a name, for example \"place block\""),
        ("replay a.mcap --infer --tolerance=-1", "a number of 0 or more"),
        ("replay a.mcap --infer --tolerance NaN", "a number of 0 or more"),
        ("eval --trials 0", "at least 1"),
        ("artifacts --install --to x", "cannot be used with '--to"),
        ("--tag a=1 --tag b=1 --tag a=2", "--tag a is given twice"),
        ("replay x.mcap --record --tag a=1 --tag a=1", "--tag a is given twice"),
        ("--instance a/b", "letters, digits and dashes"),
    ] {
        let message = printed(words);
        assert!(message.contains(expected), "{words}: {message}");
    }
}
