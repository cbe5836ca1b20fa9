//! How a run ends: whatever ends it, the episode is closed and whole, the mask is gone, and the exit
//! code gives the outcome.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]
#![allow(clippy::case_sensitive_file_extension_comparisons, reason = "names that rapid itself writes")]

use std::fs::File;
use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use crate::support::skip::skipped;
use crate::support::terminal::OnTerminal;
use crate::support::{self, Episode, PATIENCE, Place, recorded_code, until};
use rustix::process::{Pid, Signal, kill_process};

const RECORD: [&str; 6] = ["--sim", "--headless", "--json", "--record", "--out", "out"];

/// Waits until there is something to be judged in the one episode in `out`.
fn until_recorded(place: &Place) {
    const ENOUGH: u64 = 200_000;
    until("a file with samples", || {
        let file = place.episodes("out").pop().and_then(|name| std::fs::metadata(place.path("out").join(name)).ok());
        file.is_some_and(|file| file.len() >= ENOUGH)
    });
}

/// The one episode in `out`, read strictly.
fn whole_episode(place: &Place, what: &str) -> Episode {
    let files = place.episodes("out");
    assert!(files.len() == 1 && files[0].ends_with("_001.mcap"), "{what}: {files:?}");
    Episode::read(&place.path("out").join(&files[0]))
}

fn signal(child: &Child, signal: Signal) {
    let pid = Pid::from_raw(child.id().cast_signed()).expect("pid");
    kill_process(pid, signal).expect("signal");
}

#[test]
fn a_panic_anywhere_ends_the_run_with_a_whole_file_and_names_its_place() {
    for (at, named) in [
        ("writer", "the writer thread panicked"),
        ("mask", "thread `mask` panicked"),
        ("rig", "the rig panicked"),
        ("screen", "the screen panicked"),
        ("main", "the main task panicked"),
    ] {
        let place = Place::new();
        let order = place.path("now");
        let output = File::create(place.path("output.txt")).expect("output file");
        let child = place
            .command(&RECORD)
            .env("RAPID_FAULT", format!("{at}:{}", order.display()))
            .stdout(output)
            .spawn()
            .expect("rapid runs");
        until("an episode", || {
            std::fs::read_to_string(place.path("output.txt")).is_ok_and(|text| text.contains("\"event\":\"recording\""))
        });
        File::create(order).expect("order");
        let ended = child.wait_with_output().expect("end");
        let printed = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert_eq!(ended.status.code(), Some(1), "{at}: {printed}");
        let error = printed.lines().rfind(|line| line.starts_with("error: ")).unwrap_or_default();
        assert!(error.contains(named), "{at}: {printed}");
        assert!(
            printed.contains(&format!("fault ordered for {at}")) && printed.contains("src/system/fault.rs:"),
            "{at}: {printed}"
        );
        assert!(!place.mask_file().exists(), "{at}");
        assert!(whole_episode(&place, at).topic("/rapid/mask").count() > 0, "{at}");
    }
}

#[test]
fn a_panic_of_the_synchronisation_costs_observations_and_no_episode() {
    let place = Place::new();
    let order = place.path("now");
    let mut command = place.command(&RECORD);
    command.env("RAPID_FAULT", format!("sync:{}", order.display()));
    let mut running = place.start_as(command, "\"event\":\"recording\"");
    File::create(order).expect("order");
    running.wait_for("no more observations are published");
    until_recorded(&place);
    running.signal(Signal::INT);
    let (code, _, stderr) = running.end();
    assert_eq!(code, Some(1), "{stderr}");
    assert!(stderr.contains("the synchronisation panicked"), "{stderr}");
    assert!(whole_episode(&place, "sync").topic("/rapid/mask").count() > 0);
}

/// The end to write to of a pipe that has no room left, and the end to read from.
fn full_pipe() -> (std::io::PipeReader, std::io::PipeWriter) {
    use rustix::fs::{OFlags, fcntl_setfl};
    let (reader, mut writer) = std::io::pipe().expect("pipe");
    fcntl_setfl(&writer, OFlags::NONBLOCK).expect("flags");
    for piece in [4096, 1] {
        while std::io::Write::write(&mut writer, &vec![b'x'; piece]).is_ok() {}
    }
    fcntl_setfl(&writer, OFlags::empty()).expect("flags");
    (reader, writer)
}

#[test]
fn a_panic_ends_a_run_whose_standard_error_is_not_read() {
    for at in ["mask", "main"] {
        let place = Place::new();
        let order = place.path("now");
        let (_reader, writer) = full_pipe();
        let output = File::create(place.path("output.txt")).expect("output file");
        let mut command = place.command(&RECORD);
        command.env("RAPID_FAULT", format!("{at}:{}", order.display())).stdout(output).stderr(writer);
        let mut child = command.spawn().expect("rapid runs");
        until("an episode", || {
            std::fs::read_to_string(place.path("output.txt")).is_ok_and(|text| text.contains("\"event\":\"recording\""))
        });
        File::create(order).expect("order");
        let mut status = None;
        let begun = Instant::now();
        while status.is_none() && begun.elapsed() < PATIENCE {
            status = child.try_wait().expect("wait");
            std::thread::sleep(Duration::from_millis(5));
        }
        // A run that does not end is not to outlive its test.
        let _ = child.kill();
        let _ = child.wait();
        assert_eq!(status.and_then(|status| status.code()), Some(1), "{at}");
        assert!(!place.mask_file().exists(), "{at}");
        whole_episode(&place, at);
    }
}

#[test]
fn a_panic_in_one_device_affects_no_other() {
    let place = Place::new();
    let order = place.path("now");
    let log = File::create(place.path("output.txt")).expect("output file");
    let mut command = place.command(&RECORD);
    command.env("RAPID_FAULT", format!("stream:{}", order.display())).stdout(log);
    let child = command.spawn().expect("rapid runs");
    let output = || std::fs::read_to_string(place.path("output.txt")).unwrap_or_default();
    until("an episode", || output().contains("\"event\":\"recording\""));
    File::create(&order).expect("order");
    until("a panic", || output().contains("its reader panicked"));
    std::fs::remove_file(&order).expect("order");
    let panicked = output().len();
    until("a restart", || output()[panicked..].contains("\"state\":\"streaming\""));
    signal(&child, Signal::INT);
    assert_eq!(child.wait_with_output().expect("end").status.code(), recorded_code(&output()));
    whole_episode(&place, "stream");
}

#[test]
fn a_small_disk_that_fills_up_ends_the_run_with_a_whole_file_and_a_message() {
    const MOUNT: &str = "mount -t tmpfs -o size=8m tmpfs out && \"$@\"; code=$?; cp out/* saved; exit $code";
    let may = Command::new("unshare").args(["-Urm", "true"]).output().is_ok_and(|output| output.status.success());
    if !may {
        skipped("no disk can be mounted here (unshare -Urm)");
        return;
    }
    let place = Place::new();
    for folder in ["out", "saved"] {
        std::fs::create_dir(place.path(folder)).expect("folder");
    }
    let command = place.command(&RECORD);
    let mut inside = Command::new("unshare");
    inside.args(["-Urm", "sh", "-c", MOUNT, "sh"]).arg(command.get_program()).args(command.get_args());
    inside
        .current_dir(place.folder.path())
        .stdin(Stdio::null())
        .env("HOME", place.folder.path())
        .env("RAPID_INSTANCE", &place.instance);
    let ended = inside.output().expect("rapid runs");
    let (shown, printed) = (String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
    assert_eq!(ended.status.code(), Some(1), "{printed}");
    assert!(shown.contains("\"event\":\"disk_low\""), "{shown}");
    let files = place.files("saved");
    assert!(files.len() == 1 && files[0].ends_with("_001.mcap"), "{files:?} {printed}");
    assert!(printed.contains(&format!("error: out/{}: ", files[0])) && printed.contains("--out"), "{printed}");
    let episode = Episode::read(&place.path("saved").join(&files[0]));
    let bytes: usize = episode.messages.iter().map(|message| message.data.len()).sum();
    assert!(bytes > 1 << 20, "{bytes} bytes recorded before the end");
}

/// Two cameras of 30 MB a second together.
const LARGE_RIG: &str = "[rig]\nname = \"large\"\nmemory_budget = \"64MiB\"\n\
    [device.cam_a]\nvid = \"046d\"\npid = \"0825\"\nserial = \"A\"\nnode = \"camera\"\nbit = 0\ndepth = 16\n\
    max_bytes = \"600KiB\"\n\
    [device.cam_b]\nvid = \"046d\"\npid = \"0825\"\nserial = \"B\"\nnode = \"camera\"\nbit = 1\ndepth = 16\n\
    max_bytes = \"600KiB\"\n";
const LARGE: &str =
    "[[device]]\nname = \"cam_a\"\nbytes = \"500kB\"\n[[device]]\nname = \"cam_b\"\nbytes = \"500kB\"\n";

#[test]
fn an_episode_is_closed_before_its_file_is_larger_than_the_limit_for_files() {
    let place = Place::new();
    place.write("devices.toml", LARGE_RIG);
    place.write("sim.toml", LARGE);
    // In blocks of 1024 bytes.
    let arguments =
        ["--config", "devices.toml", "--sim", "sim.toml", "--headless", "--json", "--record", "--out", "out"];
    let command = place.command(&arguments);
    let mut limited = Command::new("bash");
    limited.args(["-c", "ulimit -f 120000 && exec \"$@\"", "bash"]).arg(command.get_program()).args(command.get_args());
    limited
        .current_dir(place.folder.path())
        .stdin(Stdio::null())
        .env("HOME", place.folder.path())
        .env("RAPID_INSTANCE", &place.instance);
    let ended = limited.output().expect("rapid runs");
    let (shown, printed) = (String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
    assert_eq!(ended.status.code(), Some(1), "{printed}");
    let episode = whole_episode(&place, "limited");
    let reason = episode.value("rapid/summary", "cut_short");
    assert!(
        reason.contains("out: ") && reason.contains("122.9 MB") && reason.contains("ulimit -f unlimited"),
        "{reason}"
    );
    assert!(printed.contains(&format!("_001.mcap: {reason}")), "{printed}");
    // It was said while there was time.
    assert!(shown.contains("the episode will be closed in about"), "{shown}");
    let bytes: usize = episode.messages.iter().map(|message| message.data.len()).sum();
    assert!(bytes > 100_000_000, "{bytes} bytes recorded before the end");
}

#[test]
fn a_command_outlives_files_that_are_too_large() {
    let place = Place::new();
    let mut command = Command::new("bash");
    let rapid = place.command(&["keys", "--schema"]);
    command.args(["-c", "ulimit -f 1; \"$@\" > keys.json", "bash"]).arg(rapid.get_program()).args(rapid.get_args());
    let ended = command.current_dir(place.folder.path()).output().expect("rapid runs");
    let printed = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.code() == Some(1) && printed.contains("error: "), "{:?}: {printed}", ended.status);
}

#[test]
fn two_signals_exit_with_130_and_the_file_is_whole() {
    let place = Place::new();
    let running = place.start(&RECORD, "\"event\":\"recording\"");
    running.signal(Signal::INT);
    running.signal(Signal::TERM);
    let (code, _, printed) = running.end();
    assert_eq!(code, Some(130), "{printed}");
    whole_episode(&place, "interrupted twice");
    assert!(!place.mask_file().exists());
}

#[test]
fn one_interrupt_while_a_run_ends_by_itself_counts_once() {
    let place = Place::new();
    let child = place.command(&[&RECORD[..], &["--duration", "1s"]].concat()).spawn().expect("rapid runs");
    // The run ends because its episode has; its output is waited for as long as no one reads.
    until("a whole file", || place.files("out").iter().any(|file| file.ends_with(".mcap")));
    signal(&child, Signal::INT);
    let ended = child.wait_with_output().expect("end");
    let code = recorded_code(&String::from_utf8_lossy(&ended.stdout));
    assert_eq!(ended.status.code(), code, "{}", String::from_utf8_lossy(&ended.stderr));
    whole_episode(&place, "ended by itself");
}

#[test]
fn a_run_that_is_stopped_and_continued_reports_no_error() {
    let place = Place::new();
    let mut child = place
        .command(&RECORD)
        .stdout(File::create(place.path("output.txt")).expect("output file"))
        .spawn()
        .expect("rapid runs");
    until_recorded(&place);
    for _ in 0..10 {
        signal(&child, Signal::STOP);
        std::thread::sleep(Duration::from_millis(30));
        signal(&child, Signal::CONT);
        std::thread::sleep(Duration::from_millis(30));
    }
    signal(&child, Signal::INT);
    let status = child.wait().expect("end");
    assert!(status.code().is_some(), "{status}");
    let output = std::fs::read_to_string(place.path("output.txt")).expect("output");
    let errors: Vec<&str> = output.lines().filter(|line| line.contains("/rapid/wake")).collect();
    assert!(errors.is_empty(), "{errors:?}");
    assert!(output.lines().any(|line| line.contains("\"event\":\"recording\"")), "{output}");
}

#[test]
fn a_terminal_that_is_closed_ends_the_run_with_a_whole_file() {
    let monitor: &[&str] = &["--sim", "--record", "--out", "out"];
    let headless: &[&str] = &["--sim", "--headless", "--record", "--out", "out"];
    for arguments in [monitor, headless] {
        let place = Place::new();
        let mut run = OnTerminal::start(&place, arguments, "");
        run.read_until(if arguments == monitor { "REC" } else { "recording" });
        until_recorded(&place);
        // Closing the master hangs the terminal up.
        run.master = None;
        until("the end", || run.child.try_wait().expect("wait").is_some());
        let code = run.child.wait().expect("wait").code();
        // What became of the episode cannot be read from a terminal that is gone.
        assert!(code == Some(0) || (arguments == headless && code == Some(4)), "{arguments:?}: {code:?}");
        whole_episode(&place, "hung up");
        assert!(!place.mask_file().exists());
    }
}

#[test]
fn the_monitor_gives_the_terminal_back_after_a_panic() {
    let place = Place::new();
    for at in ["screen", "writer", "mask"] {
        let order = place.path(&format!("now-{at}"));
        let mut run = OnTerminal::start(&place, &["--sim", "--out", "out"], &format!("{at}:{}", order.display()));
        run.read_until("cam_wrist");
        assert!(!run.echoes(), "{at}");
        File::create(&order).expect("order");
        let mut shown = File::from(run.master.as_ref().expect("open").try_clone().expect("clone"));
        let reading = std::thread::spawn(move || {
            let (mut text, mut piece) = (Vec::new(), [0; 4096]);
            while let Ok(count @ 1..) = shown.read(&mut piece) {
                text.extend_from_slice(&piece[..count]);
            }
            String::from_utf8_lossy(&text).into_owned()
        });
        let mut status = None;
        until("the end", || {
            status = run.child.try_wait().expect("wait");
            status.is_some()
        });
        assert_eq!(status.and_then(|status| status.code()), Some(1), "{at}");
        assert!(run.echoes(), "{at}: still raw");
        run.master = None;
        let text = reading.join().expect("text");
        assert!(text.contains("\x1b[?1049l") && text.contains("\x1b[?25h"), "{at}: {text}");
        // Pasted text is marked while the monitor is up, and not afterwards.
        assert!(text.contains("\x1b[?2004l"), "{at}: {text}");
        assert!(text.contains(&format!("fault ordered for {at}")) && text.contains("error:"), "{at}: {text}");
        assert!(!place.mask_file().exists(), "{at}");
    }
}

#[test]
fn a_full_output_loses_output_and_not_the_episode() {
    let place = Place::new();
    let full = File::options().write(true).open("/dev/full").expect("/dev/full");
    let mut command = place.command(&[&RECORD[..], &["--duration", "2s"]].concat());
    let ended = command.stdout(full).output().expect("rapid runs");
    let printed = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert_eq!(ended.status.code(), Some(1), "{printed}");
    assert!(printed.contains("error: output: "), "{printed}");
    let episode = whole_episode(&place, "full");
    assert!(episode.topic("/rapid/frame").count() >= 59, "30 Hz for 2 s");
}

/// Closing the camera takes this long.
const SLOW: &str = r#"
[[device]]
name = "cam_wrist"
[device.fault]
close = "2s"
[[device]]
name = "motor_state"
"#;
const CLOSES_IN: Duration = Duration::from_secs(2);

/// The end of the one episode in `out`, on the wall clock.
fn end_of_episode(place: &Place, what: &str) -> SystemTime {
    let episode = whole_episode(place, what);
    let begin: u64 = episode.value("rapid", "begin_wall_ns").parse().expect("begin");
    let seconds: f64 = episode.value("rapid/summary", "duration_s").parse().expect("length");
    let ticks = episode.topic("/rapid/frame").count() as f64;
    assert!((seconds * 30.0 - ticks).abs() <= 1.0, "{what}: {ticks} frames in {seconds} s");
    SystemTime::UNIX_EPOCH + Duration::from_nanos(begin) + Duration::from_secs_f64(seconds)
}

/// What closes slowly after the end of an episode was asked for is not part of the episode: it ended before the device
/// began to close, which was this long before the program ended.
fn ended_before_its_devices_closed(place: &Place, exited: SystemTime, what: &str) {
    let before = exited.duration_since(end_of_episode(place, what)).expect("an episode ends before its program");
    assert!(before >= CLOSES_IN, "{what}: ended {before:?} before the program did, closing takes {CLOSES_IN:?}");
}

#[test]
fn an_episode_ends_when_asked_however_slowly_its_devices_close() {
    let signals = [Signal::INT, Signal::TERM, Signal::QUIT, Signal::HUP];
    let ways = signals.map(|signal| (format!("{signal:?}"), Some(signal)));
    for (what, signal) in ways.into_iter().chain([("duration".to_owned(), None)]) {
        let place = Place::new();
        place.write("slow.toml", SLOW);
        let mut arguments = vec!["--sim", "slow.toml", "--headless", "--json", "--record", "--out", "out"];
        if signal.is_none() {
            arguments.extend(["--duration", "1s"]);
        }
        let running = place.start(&arguments, "\"event\":\"recording\"");
        if let Some(signal) = signal {
            until_recorded(&place);
            running.signal(signal);
        }
        let (code, output, printed) = running.end();
        let exited = SystemTime::now();
        assert_eq!(code, recorded_code(&output), "{what}: {printed}");
        ended_before_its_devices_closed(&place, exited, &what);
    }
}

#[test]
fn the_monitor_ends_an_episode_when_asked_however_slowly_its_devices_close() {
    for (what, keys) in [("space, then q", &[" ", "q", "q"][..]), ("q twice", &["q", "q"]), ("hang-up", &[])] {
        let place = Place::new();
        place.write("slow.toml", SLOW);
        let mut run = OnTerminal::start(&place, &["--sim", "slow.toml", "--record", "--out", "out"], "");
        run.read_until("REC");
        let mut shown = File::from(run.master.as_ref().expect("open").try_clone().expect("clone"));
        let reading = (!keys.is_empty()).then(|| {
            std::thread::spawn(move || {
                let mut piece = [0; 4096];
                while let Ok(1..) = shown.read(&mut piece) {}
            })
        });
        for key in keys {
            run.type_in(key);
            if *key == " " {
                until("a whole file", || place.files("out").iter().any(|file| file.ends_with(".mcap")));
            }
        }
        if keys.is_empty() {
            run.master = None;
        }
        until("the end", || run.child.try_wait().expect("wait").is_some());
        let exited = SystemTime::now();
        assert_eq!(run.child.wait().expect("wait").code(), Some(0), "{what}");
        run.master = None;
        reading.map(std::thread::JoinHandle::join).transpose().expect("the reader ends");
        ended_before_its_devices_closed(&place, exited, what);
    }
}

#[test]
fn a_headless_run_that_ends_with_a_bad_episode_exits_with_code_4() {
    // All devices are registered and none sends: every one is plugged in and silent.
    const SILENT: &str = "[[device]]\nname = \"motor_state\"\n[[event]]\nat = \"0s\"\nsilence = \"motor_state\"\n";
    const FINE: &str = "[[device]]\nname = \"motor_state\"\n";
    for (scenario, screen, expected) in [
        (SILENT, "--json", Some(4)),
        (SILENT, "--headless", Some(4)),
        (FINE, "--json", Some(0)),
        (FINE, "--headless", Some(0)),
    ] {
        let place = Place::lenient();
        place.write("play.toml", scenario);
        let run = ["--sim", "play.toml", "--headless", "--record", "--out", "out", "--duration", "3s"];
        let more: &[&str] = if screen == "--json" { &["--json"] } else { &[] };
        let ended = place.run(&[&run[..], more].concat());
        let (shown, printed) = (String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
        assert_eq!(recorded_code(&shown), expected, "{shown}");
        assert_eq!(ended.status.code(), expected, "{printed}");
        assert_eq!(printed.contains("_001.mcap is BAD"), expected == Some(4), "{printed}");
        whole_episode(&place, screen);
    }
}

#[test]
fn a_run_without_any_device_reports_it() {
    for (plugged, expected) in [("false", 1), ("true", 0)] {
        let place = Place::new();
        place.write("play.toml", &format!("[[device]]\nname = \"motor_state\"\nplugged = {plugged}\n"));
        let ended = place.run(&["--sim", "play.toml", "--headless", "--json", "--duration", "5s"]);
        let events = support::events(&String::from_utf8_lossy(&ended.stdout));
        let printed = support::logged(&events, "no device of the registry is plugged in");
        assert_eq!((printed.len(), ended.status.code()), (expected, Some(0)), "{printed:?}");
    }
}
