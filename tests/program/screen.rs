//! A day of collection in a real terminal: what a user sees and types, in tmux.
//!
//! Words are looked for where a user would look for them; the layout is a matter of the snapshots in `src/screens/tui`.

use std::time::Duration;

use crate::support::skip::skipped;
use crate::support::tmux::{PROMPT, Pane, Tmux};
use crate::support::{Episode, LENIENT, Place, Running, until};
use rustix::process::{Signal, kill_process};
use serde_json::Value;

/// Columns and rows of an ordinary terminal.
const USUAL: (usize, usize) = (120, 40);
/// The three devices of `devices.toml`, of which none is unplugged by itself.
const QUIET: &str =
    "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\nname = \"motor_state\"\n";
/// Starts the rig with the monitor.
const RIG: &str = "rapid --sim quiet.toml --out out";

/// A place with a rig whose devices stay plugged in.
fn place() -> Place {
    let place = Place::new();
    place.write("quiet.toml", QUIET);
    let registry = include_str!("../../devices.toml").replace("cooldown = \"2s\"", "cooldown = \"200ms\"");
    place.write("devices.toml", &(registry + LENIENT));
    place
}

/// Opens the monitor with this command, and waits for three devices that stream.
fn streaming<'a>(tmux: &'a Tmux, name: &str, size: (usize, usize), command: &str) -> Pane<'a> {
    let pane = tmux.pane(name, size);
    pane.order(command);
    pane.until("three devices stream", |screen| screen.matches(" streaming ").count() >= 3 && screen.contains("0x07"));
    pane
}

/// A press within 400 ms of the last one counts as its repeat, by the clock of the snapshots.
fn next_press() {
    std::thread::sleep(Duration::from_secs(1));
}

/// Returns to the rig. A key that follows at once would make one key with it.
fn escape(pane: &Pane<'_>) {
    pane.press("Escape");
    pane.shows(&["─ Mask", "─ Recording"]);
}

/// Begins an episode.
fn begin(pane: &Pane<'_>) {
    next_press();
    pane.type_in(" ");
    pane.shows(&["● REC 0"]);
}

/// Seconds of the episode, as the screen shows them. A busy machine may not show each.
fn recorded(screen: &str) -> Option<u32> {
    let (minutes, rest) = screen.split_once("● REC ")?.1.split_once(':')?;
    Some(60 * minutes.parse::<u32>().ok()? + rest.get(..2)?.parse::<u32>().ok()?)
}

/// Ends the episode; returns the screen with its verdict.
fn end(pane: &Pane<'_>) -> String {
    next_press();
    pane.type_in(" ");
    pane.hides("● REC");
    pane.until("a verdict", |screen| ["last GOOD", "last SUSPECT", "last BAD"].iter().any(|word| screen.contains(word)))
}

/// Ends the program and its session; returns what is left on the terminal.
fn quit(pane: &Pane<'_>) -> String {
    pane.type_in("q");
    // The prompt of before, and that after the end.
    let left = pane.until("the shell is back", |screen| screen.matches(PROMPT).count() == 2);
    // What is typed is shown again, and on a line of its own.
    pane.order("echo as be''fore");
    pane.until("the terminal echoes", |screen| {
        screen.contains("echo as be''fore") && screen.lines().any(|line| line == "as before")
    });
    left
}

/// What `rapid session --json` prints.
fn session(place: &Place) -> Value {
    let output = place.run(&["session", "--json", "--instance", &place.instance]);
    serde_json::from_slice(&output.stdout).unwrap_or_default()
}

/// An episode of the session, from 0.
fn entry(place: &Place, number: usize) -> Value {
    session(place)["episodes"][number].clone()
}

/// The files of whole episodes.
fn whole(place: &Place) -> Vec<String> {
    let (mut names, partial) = (place.episodes("out"), ".partial");
    names.retain(|name| name.contains(".mcap") && !name.ends_with(partial));
    names
}

/// The row of a device in the table.
fn row<'a>(screen: &'a str, device: &str) -> &'a str {
    let is_row = |line: &&str| line.split_whitespace().take(3).any(|word| word == device) && !line.contains('■');
    screen.lines().skip_while(|line| !line.contains("─ Devices")).find(is_row).unwrap_or_default()
}

#[test]
fn ten_episodes_are_counted_down_recorded_and_counted() {
    let place = place();
    let tmux = Tmux::new(&place);
    let plan = "--goal 10 --episode-time 600ms --reset-time 300ms --countdown 300ms";
    let pane = streaming(&tmux, "plan", USUAL, &format!("{RIG} {plan} --task pour"));
    pane.type_in("?");
    pane.shows(&["Keys: episodes and motion", "start an episode, end the one in progress"]);
    pane.type_in("?");
    pane.shows(&["Keys: the screen; states", "attached, waiting for the first sample"]);
    pane.type_in("?");
    pane.hides("Keys:");
    pane.shows(&["0 of 10 episodes", "space starts an episode"]);

    pane.type_in(" ");
    let mut seen = Vec::new();
    pane.until_seeing("ten episodes", &mut seen, |_| whole(&place).len() == 10);
    for words in ["an episode begins in 00:0", "reset the scene: the next episode begins in 00:0", "● REC 00:0"] {
        assert!(seen.iter().any(|screen| screen.contains(words)), "{words:?} in none of {} screens", seen.len());
    }
    let count = |screen: &str| {
        let rest = screen.split_once(" of disk left")?.0.rsplit_once("episode ")?.1;
        rest.split_once(" of 10, ")?.0.parse::<usize>().ok()
    };
    let mut counts: Vec<_> = seen.iter().filter_map(|screen| count(screen)).collect();
    assert!(counts.is_sorted() && counts.iter().all(|count| (1..=10).contains(count)), "{counts:?}");
    counts.dedup();
    // A screen that is looked at seldom misses some.
    assert!(counts.len() >= 3, "{counts:?}");
    until("the journal has ten", || session(&place)["phase"]["phase"] == "idle");
    assert_eq!(session(&place)["counted"], 10);
    assert!(place.files("out").contains(&"session.toml".to_owned()));
    let last = pane.shows(&["10 of 10 episodes"]);
    assert!(!last.contains("begins in"), "no other begins:\n{last}");

    let left = quit(&pane);
    assert!(left.contains("10"), "{left}");
    assert!(!left.contains("─ Devices"), "{left}");
    let ending = ".md";
    let of_session = |name: &&String| name.starts_with("session-") && name.ends_with(ending);
    let files = place.files("out");
    let summaries: Vec<_> = files.iter().filter(of_session).collect();
    assert_eq!(summaries.len(), 1, "{files:?}");
    let summary = std::fs::read_to_string(place.path("out").join(summaries[0])).expect("the summary");
    assert!(summary.contains("pour"), "{summary}");
}

#[test]
fn a_device_that_is_unplugged_by_a_key_is_seen_to_go_and_to_return() {
    let place = place();
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "unplug", USUAL, RIG);
    begin(&pane);
    pane.type_in("U");
    let screen = pane.shows(&["mask 0x06", "2 of 3 present", "cam_wrist unplugged"]);
    assert!(row(&screen, "cam_wrist").contains("absent"), "{screen}");
    pane.until("its cell and its row", |screen| {
        screen.contains("□  0 cam_wrist") && row(screen, "cam_wrist").contains("unplugged")
    });
    assert!(pane.screen().contains("● REC"));
    pane.type_in("U");
    let screen = pane.shows(&["mask 0x07", "3 of 3 present", "● REC"]);
    assert!(row(&screen, "cam_wrist").contains("streaming"), "{screen}");
    pane.shows(&["■  0 cam_wrist"]);
    end(&pane);
    let files = whole(&place);
    assert_eq!(files.len(), 1, "{files:?}");
    let edges = Episode::read(&place.path("out").join(&files[0])).mask_edges();
    assert_eq!(edges.iter().map(|(_, mask)| *mask).collect::<Vec<_>>(), [7, 6, 7]);
    quit(&pane);
}

#[test]
fn episodes_are_discarded_taken_back_repeated_marked_labelled_and_noted() {
    let place = place();
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "keys", USUAL, RIG);
    let trash = || place.files("out/.trash");
    begin(&pane);
    pane.type_in("i");
    until("a mark", || entry(&place, 0)["marks"].as_array().is_some_and(|marks| marks.len() == 1));
    pane.type_in("nnew pads");
    pane.shows(&["note: new pads█"]);
    pane.press("Enter");
    until("a note", || entry(&place, 0)["note"] == "new pads");
    end(&pane);
    pane.type_in("+");
    until("a success", || entry(&place, 0)["label"] == "success");
    pane.shows(&["success", "1 mark"]);
    pane.type_in("-it slipped");
    pane.shows(&["why it failed (may be empty): it slipped█"]);
    pane.press("Enter");
    until("a failure", || entry(&place, 0)["label_reason"] == "it slipped");
    assert_eq!(entry(&place, 0)["label"], "failure");
    pane.shows(&["failure", "it slipped"]);

    // An ended one goes to the trash, and comes back.
    next_press();
    pane.type_in("x");
    // With what was noted about it.
    let endings =
        || trash().iter().filter_map(|name| name.split_once(".mcap")).map(|(_, end)| end.to_owned()).collect();
    until("it is in the trash", || {
        let endings: Vec<String> = endings();
        endings == ["", ".toml"]
    });
    assert_eq!(whole(&place).len(), 0);
    pane.shows(&["1 in the trash", "undo"]);
    pane.type_in("u");
    until("it is back", || whole(&place).len() == 1 && trash().is_empty());
    pane.hides("1 in the trash");

    // One in progress is recorded again.
    begin(&pane);
    until("the second is in the journal", || entry(&place, 1)["file"].is_string());
    next_press();
    pane.press("Left");
    until("the third is in the journal", || entry(&place, 2)["file"].is_string());
    until("the second is in the trash", || trash().iter().any(|name| name.contains("_002")));
    pane.shows(&["● REC", "_003"]);
    next_press();
    pane.type_in("x");
    until("the third too", || trash().iter().any(|name| name.contains("_003")));
    pane.hides("● REC");
    let status = session(&place);
    assert_eq!((&status["discarded"], status["episodes"].as_array().map(Vec::len)), (&2.into(), Some(3)), "{status}");
    assert_eq!(status["episodes"][1]["discarded"], true, "{status}");
    assert_eq!(whole(&place).len(), 1);
    quit(&pane);
    let kept: Vec<String> = endings();
    assert_eq!(kept, ["", ""], "the end of the program deletes nothing");
}

#[test]
fn a_disk_that_fills_up_is_seen_and_the_monitor_stays() {
    let may = std::process::Command::new("unshare").args(["-Urm", "true"]).output();
    if !may.is_ok_and(|output| output.status.success()) {
        skipped("no disk can be mounted here (unshare -Urm)");
        return;
    }
    let place = place();
    std::fs::create_dir(place.path("out")).expect("folder");
    // Two of eight megabytes: an episode of some seconds, and none after it.
    let registry = std::fs::read_to_string(place.path("devices.toml")).expect("the registry");
    place.write("devices.toml", &registry.replacen("[rig]\n", "[rig]\ndisk_reserve = \"6MiB\"\n", 1));
    let tmux = Tmux::new(&place);
    // As the user of the test again: root would not trust a registry in folders of others.
    let (user, group) = (rustix::process::geteuid().as_raw(), rustix::process::getegid().as_raw());
    let back = format!("exec unshare --user --map-user={user} --map-group={group} {RIG}");
    let mount = format!("unshare -Urm sh -c 'mount -t tmpfs -o size=8m tmpfs out && {back}'");
    let pane = streaming(&tmux, "disk", USUAL, &mount);
    begin(&pane);
    pane.shows(&["▲ disk full in 00:"]);
    // The episode ends by itself, and the reason is where the verdict is.
    pane.hides("● REC");
    pane.shows(&["last SUSPECT", "the disk is nearly full"]);
    next_press();
    pane.type_in(" ");
    let screen = pane.shows(&["▲ not started: out: the disk is full"]);
    assert_eq!(screen.matches(" streaming ").count(), 3, "the rig continues:\n{screen}");
    quit(&pane);
}

/// What every screen of the rig has, whatever its size.
fn check_layout(screen: &str, (columns, rows): (usize, usize)) {
    let lines: Vec<Vec<char>> = screen.lines().map(|line| line.chars().collect()).collect();
    assert_eq!(lines.len(), rows, "rows:\n{screen}");
    assert!(lines.iter().all(|line| line.len() <= columns), "columns:\n{screen}");
    let text = |line: usize| lines[line].iter().collect::<String>();
    assert!(text(0).starts_with(" rapid bench-1") && text(0).contains("● REC 0"), "header:\n{screen}");
    assert!(
        text(rows - 1).starts_with(" space end episode") && text(rows - 1).ends_with("q quit"),
        "footer:\n{screen}"
    );
    // The rule of each panel occurs once and is as wide as the part of the screen that it is in.
    let width = if columns >= 160 && rows >= 40 { columns - 63 } else { columns };
    for title in ["Mask", "Devices", "Recording", "Log"] {
        let rules: Vec<_> = lines.iter().filter(|line| line.starts_with(&chars(&format!(" ─ {title} ")))).collect();
        assert_eq!(rules.len(), 1, "{title}:\n{screen}");
        assert_eq!(rules[0].get(width - 2), Some(&'─'), "{title}:\n{screen}");
        let is_end = |column: &char| *column == ' ' || width < columns;
        assert!(rules[0].get(width - 1).is_none_or(is_end), "{title}:\n{screen}");
    }
    for device in ["cam_wrist", "tactile_tip", "motor_state"] {
        assert!(row(screen, device).contains("● streaming"), "{device}:\n{screen}");
    }
}

fn chars(text: &str) -> Vec<char> {
    text.chars().collect()
}

#[test]
fn a_screen_of_another_size_is_drawn_anew_and_shows_that_it_records() {
    let place = place();
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "sizes", USUAL, RIG);
    begin(&pane);
    for size in [USUAL, (80, 24), (200, 60), (50, 10), USUAL] {
        let (columns, rows) = size;
        pane.resize(size);
        if size == (50, 10) {
            let screen = pane.shows(&["● REC 0", "needs 60x12, has 50x10"]);
            assert!(!screen.contains("streaming"), "{screen}");
            continue;
        }
        // The line of keys is the last of a screen that has been drawn in this size.
        let screen = pane.until(&format!("{columns}x{rows}"), |screen| {
            let lines: Vec<_> = screen.lines().collect();
            let is_drawn = lines.len() == rows && lines.last().is_some_and(|line| line.ends_with("q quit"));
            let rule = lines.iter().find(|line| line.starts_with(" ─ Mask ")).map_or(0, |line| line.chars().count());
            is_drawn && (if columns >= 160 { rule > 120 } else { rule == columns - 1 })
        });
        check_layout(&screen, size);
    }
    end(&pane);
    quit(&pane);
}

#[test]
fn the_pages_show_a_device_the_log_and_the_episodes() {
    let place = place();
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "pages", USUAL, RIG);
    // A reason for the page of the episodes: a device that is attached for some of it only.
    begin(&pane);
    pane.type_in("U");
    pane.shows(&["mask 0x06"]);
    pane.type_in("U");
    pane.shows(&["mask 0x07"]);
    end(&pane);

    // A picture in characters, and numbers as a plot.
    pane.press("Enter");
    let screen = pane.until("a picture", |screen| {
        let shades = |c: &char| " .:-=+*#%@".contains(*c) && *c != ' ';
        screen.contains("640x480") && screen.chars().filter(shades).count() > 500
    });
    for words in ["─ Newest sample", "─ cam_wrist", "identity 046d:0825, serial CAM00A1", "─ Intervals", "─ Its log"]
    {
        assert!(screen.contains(words), "{words}:\n{screen}");
    }
    pane.type_in("c");
    pane.shows(&["pictures are off (c shows them)"]);
    pane.type_in("c");
    pane.press("End");
    // The newest values, one of each picture of the screen: of longer than a second on a machine that draws few.
    pane.until("a plot with its times", |screen| {
        let times = |line: &str| {
            let (first, last) = line.split_once(" s ")?;
            Some(first.trim().strip_prefix('-')?.parse::<u32>().ok()? > 0 && last.trim() == "now")
        };
        screen.contains("─ motor_state") && screen.lines().any(|line| times(line) == Some(true))
    });
    escape(&pane);

    pane.type_in("l");
    pane.until("the log", |screen| screen.contains("─ Log") && !screen.contains("─ Mask"));
    pane.type_in("/tactile");
    pane.shows(&["lines of the log with: tactile█"]);
    pane.press("Enter");
    pane.until("lines about one device", |screen| {
        let lines: Vec<_> =
            screen.lines().filter(|line| line.contains("  INFO ") || line.contains("  info ")).collect();
        screen.contains("/tactile") && !lines.is_empty() && lines.iter().all(|line| line.contains("tactile"))
    });
    escape(&pane);
    pane.type_in("l");
    pane.until("the whole log", |screen| screen.contains("─ Log") && !screen.contains("/tactile"));
    for words in ["warnings and errors", " errors", "all levels"] {
        pane.type_in("v");
        pane.shows(&[words]);
    }
    pane.type_in("v");
    pane.hides("all levels");
    // Narrow enough that a line is cut, then continued.
    pane.resize((60, 20));
    pane.until("lines are cut", |screen| screen.lines().any(|line| line.ends_with('…')));
    pane.type_in("w");
    pane.until("lines are continued", |screen| !screen.lines().any(|line| line.ends_with('…')));
    pane.resize(USUAL);
    let count = |screen: &str| screen.lines().filter(|line| line.contains("cam_wrist")).count();
    let grouped = count(&pane.until("the usual size", |screen| screen.lines().count() == USUAL.1));
    pane.type_in("g");
    pane.until("each repeat by itself", |screen| count(screen) > grouped && !screen.contains("(×"));
    escape(&pane);

    pane.type_in("e");
    let screen = pane.shows(&["─ Episodes", "▸ ", "verdict   "]);
    for words in ["_001.mcap", "begun", "took part ", "of 3 sensors", "folder"] {
        assert!(screen.contains(words), "{words}:\n{screen}");
    }
    let reasons = entry(&place, 0)["reasons"].as_array().cloned().unwrap_or_default();
    for reason in reasons.iter().filter_map(Value::as_str) {
        let beginning: String = reason.chars().take(60).collect();
        assert!(screen.contains(&beginning), "{reason}:\n{screen}");
    }
    escape(&pane);
    quit(&pane);
}

/// A run without a screen, in the same place.
fn headless(place: &Place) -> Running {
    place.start(&["--sim", "quiet.toml", "--headless", "--out", "out"], "motor_state")
}

#[test]
fn viewers_come_and_go_and_the_episode_continues() {
    let place = place();
    let run = headless(&place);
    let tmux = Tmux::new(&place);
    // `exec`: the terminal has no other process than the monitor.
    let [one, two, third] = ["one", "two", "third"].map(|name| streaming(&tmux, name, (100, 30), "exec rapid monitor"));
    let only = streaming(&tmux, "only", (80, 24), "exec rapid monitor --read-only");
    one.shows(&["attached"]);
    only.shows(&["attached, read-only"]);

    begin(&one);
    for other in [&two, &third, &only] {
        other.shows(&["● REC 0"]);
    }
    next_press();
    only.type_in(" ");
    only.shows(&["read-only: `rapid monitor` without --read-only controls the run"]);
    two.type_in("nseen by all");
    two.press("Enter");
    until("a note of the second", || entry(&place, 0)["note"] == "seen by all");

    // Each viewer ends in another way.
    kill_process(one.process(), Signal::HUP).expect("a signal");
    kill_process(two.process(), Signal::KILL).expect("a signal");
    let viewer = third.process();
    third.hang_up();
    until("two are gone", || !one.is_open() && !two.is_open());
    until("the third is gone", || rustix::process::test_kill_process(viewer).is_err());
    only.shows(&["● REC 0"]);
    only.type_in("q");
    until("the last has left", || !only.is_open());
    assert_eq!(session(&place)["phase"]["phase"], "recording");
    assert_eq!(whole(&place).len(), 0);

    // The next one sees it, and ends it.
    let later = streaming(&tmux, "later", USUAL, "rapid monitor");
    later.shows(&["● REC 0", "attached"]);
    end(&later);
    let episode = entry(&place, 0);
    // A loaded machine delays samples; none is lost between driver and file, nor is anything missing in it.
    let reasons = episode["reasons"].to_string();
    assert!(!["dropped", "unfinished", "recovered"].iter().any(|word| reasons.contains(word)), "{episode}");
    let file = Episode::read(&place.path("out").join(episode["file"].as_str().expect("a name")));
    let edges: Vec<_> = file.mask_edges().iter().map(|(_, mask)| *mask).collect();
    assert_eq!(edges, [7], "{episode}");

    // The end of the run, and the next run.
    run.signal(Signal::INT);
    let screen = later.shows(&["RUN ENDED 00:", "waiting for the next"]);
    assert!(!screen.contains("● REC"), "{screen}");
    later.resize((60, 12));
    later.until("the same on the smallest screen", |screen| {
        screen.lines().count() == 12 && screen.lines().next().is_some_and(|header| header.contains("  RUN ENDED 00:"))
    });
    later.resize(USUAL);
    // Not the space bar: its presses are distinguished by the clock of the snapshots, which stands still.
    later.type_in("u");
    later.shows(&["the run has ended: nothing receives this"]);
    assert!(run.end().0.is_some());
    let next = headless(&place);
    later.hides("RUN ENDED");
    begin(&later);
    until("the next run records", || session(&place)["phase"]["phase"] == "recording");
    end(&later);
    let left = quit(&later);
    assert!(!left.contains("error"), "{left}");
    next.signal(Signal::INT);
    assert!(next.end().0.is_some());
}

#[test]
fn the_log_of_a_run_is_read_and_followed_from_another_terminal() {
    let place = place();
    let run = headless(&place);
    let tmux = Tmux::new(&place);
    let screen = streaming(&tmux, "screen", USUAL, "rapid monitor");
    let (log, follow) = (tmux.pane("log", (160, 100)), tmux.pane("follow", (160, 100)));
    log.order("rapid logs");
    let all = log.until("the log, and its end", |screen| screen.matches(PROMPT).count() == 2);
    for device in ["cam_wrist", "tactile_tip", "motor_state"] {
        assert!(all.contains(device), "{device}:\n{all}");
    }
    log.order("rapid logs no_such");
    log.shows(&["the run has no device \"no_such\": it has cam_wrist, tactile_tip, motor_state"]);
    follow.order("rapid logs cam_wrist -f");
    follow.shows(&["cam_wrist"]);
    screen.type_in("U");
    screen.shows(&["mask 0x06"]);
    let shown = follow.until("it is unplugged", |screen| screen.contains("mask 0x06"));
    assert!(!shown.contains("motor_state"), "{shown}");
    run.signal(Signal::INT);
    follow.until("the log ends with the run", |screen| screen.matches(PROMPT).count() == 2);
    assert!(run.end().0.is_some());
}

#[test]
fn a_terminal_without_colours_or_symbols_shows_shapes_and_words() {
    let place = place();
    let tmux = Tmux::new(&place);
    // Sequences that set a colour, and what is no ASCII.
    let has_colour = |text: &str| {
        let codes = text.split("\u{1b}[").skip(1).filter_map(|rest| rest.split_once('m'));
        codes.flat_map(|(codes, _)| codes.split(';')).any(|code| matches!(code.parse(), Ok(30..=38 | 40..=48)))
    };
    let table = [
        ("NO_COLOR=1", false, true, ["■  0 cam_wrist", "● streaming"], ["□  0 cam_wrist", "○ absent"], "● REC"),
        ("TERM=dumb", false, false, ["#  0 cam_wrist", "* streaming"], [".  0 cam_wrist", "- absent"], "* REC"),
        ("TERM=linux", true, false, ["#  0 cam_wrist", "* streaming"], [".  0 cam_wrist", "- absent"], "* REC"),
    ];
    for (variable, colours, unicode, present, absent, records) in table {
        let pane = streaming(&tmux, variable, USUAL, &format!("{variable} {RIG}"));
        pane.shows(&present);
        next_press();
        pane.type_in(" ");
        pane.shows(&[records]);
        pane.type_in("U");
        let screen = pane.shows(&absent);
        assert_eq!(has_colour(&pane.coloured()), colours, "{variable}:\n{screen}");
        assert_eq!(!screen.is_ascii(), unicode, "{variable}:\n{screen}");
        next_press();
        pane.type_in(" ");
        pane.hides(records);
        quit(&pane);
        pane.hang_up();
    }
}

#[test]
fn a_device_without_an_entry_is_named_in_the_screen_and_then_recorded() {
    let place = place();
    let spare = "[[device]]\nname = \"spare\"\nlike = \"tactile_tip\"\nserial = \"SPARE1\"\nport = \"1-4\"\n";
    place.write("spare.toml", &format!("{QUIET}{spare}"));
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "first", USUAL, "rapid --sim spare.toml --out out");
    pane.shows(&["1 device without an entry: N", "N name device"]);
    pane.type_in("N");
    pane.shows(&["name of the camera", "SPARE1"]);
    // The name that is suggested is replaced.
    pane.press("C-u");
    pane.type_in("spare_cam");
    pane.press("Enter");
    let screen = pane.until("it streams, and has a bit", |screen| {
        row(screen, "spare_cam").contains("streaming") && screen.contains("mask 0x0f")
    });
    assert!(!screen.contains("without an entry"), "{screen}");
    let registry = std::fs::read_to_string(place.path("devices.toml")).expect("the registry");
    assert!(registry.contains("[device.spare_cam]") && registry.contains("serial = \"SPARE1\""), "{registry}");
    begin(&pane);
    pane.until("a second of it", |screen| recorded(screen) >= Some(2));
    end(&pane);
    let episode = Episode::read(&place.path("out").join(&whole(&place)[0]));
    assert!(episode.topic("/rapid/camera/spare_cam").count() > 0);
    quit(&pane);
}

#[test]
fn a_registry_that_is_gone_is_not_replaced_by_one_entry() {
    let place = place();
    let spare = "[[device]]\nname = \"spare\"\nlike = \"tactile_tip\"\nserial = \"SPARE1\"\nport = \"1-4\"\n";
    place.write("spare.toml", &format!("{QUIET}{spare}"));
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "gone", USUAL, "rapid --sim spare.toml --out out");
    pane.shows(&["N name device"]);
    std::fs::remove_file(place.path("devices.toml")).expect("removed");
    pane.type_in("N");
    pane.shows(&["name of the camera"]);
    pane.press("Enter");
    pane.shows(&["devices.toml is gone"]);
    assert!(!place.path("devices.toml").exists());
    quit(&pane);
}

#[test]
fn a_stopped_and_continued_monitor_has_its_terminal_again() {
    let place = place();
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "stopped", USUAL, RIG);
    let record = std::fs::read(format!("{}.json", place.mask_file().display())).expect("the mask");
    let record: serde_json::Value = serde_json::from_slice(&record).expect("JSON");
    let pid = record["pid"].as_i64().and_then(|pid| i32::try_from(pid).ok()).and_then(rustix::process::Pid::from_raw);
    rustix::process::kill_process(pid.expect("a process"), rustix::process::Signal::STOP).expect("stopped");
    // Of what the shell prints, the rest of an interrupted frame may swallow anything.
    until("the shell has the terminal", || pane.program() == "sh");
    // This shell leaves the terminal as it finds it: return is not the end of a line there.
    pane.type_in("fg");
    pane.press("C-j");
    until("the monitor has it again", || pane.program() == "rapid");
    pane.until("everything is drawn again", |screen| {
        screen.matches(" streaming ").count() >= 3 && !screen.contains("[1]") && !screen.contains("Stopped")
    });
    // Keys are read one by one.
    begin(&pane);
    end(&pane);
    quit(&pane);
}

#[test]
fn the_tour_leads_through_a_first_episode() {
    let place = place();
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "tour", (80, 24), "rapid --sim --tour --out out");
    pane.shows(&["1/4 space: an episode begins"]);
    pane.type_in(" ");
    // Without the tour a camera would be out by now: here only the user unplugs.
    pane.until("five seconds with all sensors", |screen| {
        let has = |words| screen.contains(words);
        recorded(screen) >= Some(5) && has("2/4 U: the selected sensor is unplugged") && has("0x07")
    });
    pane.type_in("U");
    pane.shows(&["3/4 U: plug it in again; its bit is clear", "0x06"]);
    pane.type_in("U");
    pane.shows(&["4/4 space: the episode ends", "0x07"]);
    end(&pane);
    pane.shows(&["? help", "q quit"]);
    quit(&pane);
}

#[test]
fn the_tour_of_a_policy_leads_through_the_loss_of_a_sensor() {
    let place = place();
    let tmux = Tmux::new(&place);
    let pane = streaming(&tmux, "policy", (80, 24), "rapid --infer --sim task --monitor --tour --out out");
    pane.shows(&["1/2 select tactile_tip (up, down), U: unplug it", "acting", "0x07"]);
    // Without what the policy requires it holds, and the tour names it.
    pane.press("Down");
    pane.press("Down");
    pane.until("arm is selected", |screen| screen.lines().any(|line| line.contains('▸') && line.contains("arm")));
    pane.type_in("U");
    pane.shows(&["1/2 U: plug arm in again, which the policy requires", "holds"]);
    pane.type_in("U");
    pane.shows(&["1/2 select tactile_tip", "acting", "0x07"]);
    pane.press("Up");
    pane.until("tactile_tip is selected", |screen| {
        screen.lines().any(|line| line.contains('▸') && line.contains("tactile_tip"))
    });
    pane.type_in("U");
    pane.shows(&["2/2 U: plug tactile_tip in again; its bit is clear", "acting", "saw mask 0x05"]);
    pane.type_in("U");
    pane.shows(&["? help", "acting", "saw mask 0x07"]);
    quit(&pane);
}

#[test]
fn in_a_folder_without_a_registry_the_screen_begins_with_an_empty_rig() {
    let place = Place::new();
    let tmux = Tmux::new(&place);
    let pane = tmux.pane("empty", (80, 24));
    pane.order("rapid");
    pane.shows(&["no devices registered", "0 of 0 present"]);
    let screen = quit(&pane);
    assert!(!screen.contains("error"), "{screen}");
    assert!(!place.path("devices.toml").exists(), "nothing was named");
}
