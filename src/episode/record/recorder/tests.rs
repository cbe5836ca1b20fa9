//! Turns of the writer without its thread, at moments that the test chooses.

use rapid_core::modality::ModalityId;
use rapid_core::sample::Encoding;

use super::*;
use crate::record::inspect;
use crate::record::tests::registry;

/// A device of two numbers, in the registry of the bench.
const TOF: u8 = 1;

/// A writer whose episode began at `begin`, and the file that it writes.
fn recording(folder: &Path, begin: Stamp) -> (Writer, PathBuf) {
    let registry = Arc::new(registry());
    let board = Arc::new(Board::new(&registry));
    let events = board.events();
    let mut config = RecorderConfig::new(registry, board);
    config.begin = Box::new(move || begin);
    let (inbox, added, references) = (mpsc::channel().1, mpsc::channel().1, References::new(mpsc::channel().1));
    let (episode, in_force) = (watch::channel(None).0, watch::channel(WallClock::now()).0);
    let mut writer = Writer::new(config, inbox, added, references, events, episode, in_force);
    let request = EpisodeRequest { out: folder.to_owned(), task: "t".to_owned(), ..EpisodeRequest::default() };
    let finished = writer.start(&request).unwrap();
    (writer, finished.with_extension("mcap.partial"))
}

/// How many samples of the device are in a file that is being written.
fn kept(partial: &Path) -> u32 {
    let found = inspect::inspect(partial).unwrap();
    found.modalities.iter().map(|modality| u32::try_from(modality.topic.messages).unwrap()).sum()
}

/// What a kill loses: the kernel has the rest. It is on the bus for a turn, and in the process until the next flush.
#[test]
fn whatever_came_half_a_second_ago_is_in_the_file() {
    const EVERY: Duration = Duration::from_millis(10);
    let (folder, begin) = (tempfile::tempdir().unwrap(), Stamp::now());
    let (mut writer, partial) = recording(folder.path(), begin);
    let mut most = Duration::ZERO;
    for number in 0..300 {
        let now = begin.after(EVERY * number);
        let header = SampleHeader {
            seq: number.into(),
            capture_ns: now.0,
            recv_ns: now.0,
            id: TOF.into(),
            epoch: 1,
            encoding: Encoding::F64 as u32,
            ..SampleHeader::default()
        };
        let Writer { streams, open, .. } = &mut writer;
        let topic = TopicId::Modality(ModalityId::new(TOF).unwrap());
        streams.receive(open.as_mut(), topic, &header, &[0; 16]);
        writer.advance(now);
        most = most.max(EVERY * (number + 1 - kept(&partial)));
    }
    assert!(most > Duration::ZERO, "a write for each sample wears out the disk");
    assert!(most <= FLUSH_EVERY, "the last {most:?} were not in the file");
    assert!(FLUSH_EVERY + TURN < Duration::from_secs(1), "a second is what is promised");
    writer.finish(begin.after(EVERY * 300), None);
    assert!(!partial.exists());
}
