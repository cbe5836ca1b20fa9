//! Lines of the log.

use std::sync::Mutex;

use super::*;

#[derive(Default, Clone)]
struct Kept(Arc<Mutex<Vec<LogLine>>>);

impl Sink for Kept {
    fn write(&self, line: LogLine) {
        self.0.lock().unwrap().push(line);
    }
}

fn lines(filter: &str, log: impl FnOnce()) -> Vec<(Level, String)> {
    let kept = Kept::default();
    let subscriber = Registry::default().with(filter_of(filter).unwrap()).with(Lines { sink: kept.clone() });
    tracing::subscriber::with_default(subscriber, log);
    let lines = kept.0.lock().unwrap();
    lines.iter().map(|line| (line.level, line.text.clone())).collect()
}

#[test]
fn a_line_has_message_fields_and_span_and_no_control_characters() {
    let got = lines("trace", || {
        let span = tracing::info_span!("slot", device = "cam_wrist");
        let _entered = span.enter();
        tracing::warn!(epoch = 3, reason = %"a\x1b[2J\nb", "no sample");
        tracing::error!(device = "cam_wrist", "gone");
    });
    assert_eq!(
        got,
        [
            (Level::Warn, "no sample epoch=3 reason=a [2J b device=cam_wrist".to_owned()),
            (Level::Error, "gone device=cam_wrist".to_owned()),
        ]
    );
}

#[test]
fn by_default_only_warnings_of_other_crates_and_errors_of_iceoryx2_are_logged() {
    let got = lines(DEFAULT, || {
        tracing::info!(target: "rapid::rig", "one");
        tracing::debug!(target: "rapid::rig", "no");
        tracing::info!(target: "v4l", "no");
        tracing::warn!(target: "v4l", "two");
        tracing::warn!(target: "iceoryx2_bb_loggers::tracing", origin = "Node {..}", "no");
        tracing::error!(target: "iceoryx2_bb_loggers::tracing", origin = "Node {..}", "three");
    });
    let texts: Vec<_> = got.into_iter().map(|(_, text)| text).collect();
    assert_eq!(texts, ["one", "two", "three"]);
}

#[test]
fn a_panic_is_logged_whatever_the_filter() {
    for filter in ["off", "rapid::rig=trace", DEFAULT, "error,rapid=off"] {
        let got = lines(filter, || tracing::error!(target: panics::TARGET, "thread 'mask' panicked"));
        assert_eq!(got, [(Level::Error, "thread 'mask' panicked".to_owned())], "{filter}");
    }
}

#[test]
fn text_lines_replace_a_progress_line_on_the_same_terminal() {
    let line = LogLine { wall_ns: 1_700_000_000_123_000_000, level: Level::Warn, text: "late".to_owned() };
    let sink = sink_to(Stderr::Text, "", io::sink());
    assert_eq!(sink.render(&line), "22:13:20.123Z  warn   late\n");
    let sink = sink_to(Stderr::Text, ERASE_LINE, io::sink());
    assert_eq!(sink.render(&line), "\r\x1b[K22:13:20.123Z  warn   late\n");
}

fn sink_to(form: Stderr, before: &'static str, out: impl Write + Send + 'static) -> StderrSink {
    let palette = rapid_status::palette::Palette::Plain;
    StderrSink { form, palette, before, outlet: outlet(out).unwrap(), lost: AtomicU64::new(0) }
}

#[test]
fn a_stalled_reader_blocks_no_writer_and_is_informed_of_lost_lines() {
    let (mut reader, writer) = io::pipe().unwrap();
    let sink = sink_to(Stderr::Text, "", writer);
    let line = |text: String| LogLine { wall_ns: 0, level: Level::Warn, text };
    // Pipe and queue fill up; from then on every line is lost.
    while sink.lost.load(Ordering::Relaxed) <= DEPTH as u64 {
        sink.write(line("x".repeat(200)));
    }
    let reading = std::thread::spawn(move || {
        let mut text = String::new();
        io::Read::read_to_string(&mut reader, &mut text).map(|_| text)
    });
    while sink.lost.load(Ordering::Relaxed) > 0 {
        sink.write(line("last".to_owned()));
        std::thread::yield_now();
    }
    drop(sink);
    let text = reading.join().unwrap().unwrap();
    assert!(text.contains(" of the log lost: their reader was behind"));
    assert!(text.ends_with("last\n"));
}

#[test]
fn what_was_logged_is_written_when_the_log_is_dropped_though_the_subscriber_keeps_its_end() {
    let (mut reader, writer) = io::pipe().unwrap();
    let sink = sink_to(Stderr::Text, "", writer);
    let log = Log(Some(Arc::clone(&sink.outlet)));
    // Fits into a pipe, so that nothing waits for the reader.
    for number in 0..100 {
        sink.write(LogLine { wall_ns: 0, level: Level::Warn, text: format!("line {number}") });
    }
    drop(log);
    let mut text = [0; 4096];
    let count = io::Read::read(&mut reader, &mut text).unwrap();
    let text = String::from_utf8_lossy(&text[..count]);
    assert_eq!((text.lines().count(), text.ends_with("line 99\n")), (100, true), "{text}");
}

/// A terminal that another program has made non-blocking.
#[test]
fn a_line_without_room_is_not_the_end_of_the_log() {
    struct Full(Arc<Mutex<Vec<u8>>>, bool);
    impl Write for Full {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if std::mem::replace(&mut self.1, false) {
                return Err(io::ErrorKind::WouldBlock.into());
            }
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    let written = Arc::default();
    let sink = sink_to(Stderr::Text, "", Full(Arc::clone(&written), true));
    for text in ["one", "two"] {
        sink.write(LogLine { wall_ns: 0, level: Level::Warn, text: text.to_owned() });
    }
    sink.outlet.drain(Duration::from_hours(1));
    let text = String::from_utf8(written.lock().unwrap().clone()).unwrap();
    assert!(!text.contains("one") && text.ends_with("two\n"), "{text:?}");
}

#[test]
fn a_wrong_filter_is_named() {
    let board = Arc::new(crate::literal::board(&["cam"]));
    let error = init(board, Some("rapid=loud"), Stderr::Nothing).unwrap_err();
    assert!(error.to_string().starts_with("RAPID_LOG: "), "{error}");
}

#[test]
fn json_lines_are_objects_and_long_lines_are_cut() {
    let sink = sink_to(Stderr::Json, "", io::sink());
    let line = LogLine { wall_ns: 1_700_000_000_123_000_000, level: Level::Warn, text: "a \"b\"".to_owned() };
    let object: serde_json::Value = serde_json::from_str(&sink.render(&line)).unwrap();
    assert_eq!(object["event"], "log");
    assert_eq!(object["level"], "warn");
    assert_eq!(object["text"], "a \"b\"");
    assert_eq!(object["time"], "2023-11-14T22:13:20.123Z");

    let got = lines("trace", || tracing::info!("{}", "ü".repeat(5000)));
    assert_eq!(got[0].1.chars().count(), LONGEST);
}
