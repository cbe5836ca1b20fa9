//! Repair in the background.

use super::super::tests::{names, put, recorded};
use super::*;
use crate::record::tests::registry;
use crate::testing::strictly;

#[tokio::test]
async fn a_folder_is_repaired_and_reported_in_the_background() {
    let (folder, bytes) = recorded().await;
    put(&folder, "a_001.mcap.partial", &bytes[..bytes.len() / 2]);
    put(&folder, "a_002.mcap.partial", b"");
    let busy = put(&folder, "a_003.mcap.partial", &bytes[..bytes.len() / 2]);
    put(&folder, "a_004.mcap", &bytes[..100]);
    let held = File::open(&busy).unwrap();
    held.lock().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let mut events = board.events();
    let repairs = Repairs::start(folder.path().to_owned(), Some(1 << 20), Arc::clone(&board), || {}).unwrap();
    let mut report = Vec::new();
    for _ in 0..3 {
        report.push(events.recv().await.unwrap().what);
    }
    let EventKind::Recovered { file, messages, text, .. } = &report[0] else { panic!("{report:?}") };
    assert_eq!((file, strictly(&fs::read(file).unwrap()).len() as u64), (&folder.path().join("a_001.mcap"), *messages));
    assert!(text.contains("a_001.mcap.partial: repaired, "), "{text}");
    assert!(
        matches!(&report[1], EventKind::Log { text, .. } if text.ends_with("a_002.mcap.partial: of no bytes; removed"))
    );
    assert!(matches!(&report[2], EventKind::Log { text, .. } if text.contains("a_003.mcap.partial: another rapid")));
    drop(repairs);
    // A finished file is left alone.
    assert_eq!(names(folder.path()), ["a_001.mcap", "a_003.mcap.partial", "a_004.mcap"]);
    assert!(Repairs::start(folder.path().join("missing"), None, board, || {}).is_ok());
}

#[tokio::test]
async fn a_repair_in_the_background_leaves_disk_space_for_an_episode() {
    let (folder, bytes) = recorded().await;
    let partial = put(&folder, "a_001.mcap.partial", &bytes[..bytes.len() / 2]);
    let free = Disk::of_file(&File::open(folder.path()).unwrap()).unwrap().free;
    let board = Arc::new(Board::new(&registry()));
    let mut events = board.events();
    // Three quarters of what is free: a repair would fit, and an episode be warned of.
    let _repairs = Repairs::start(folder.path().to_owned(), Some(free / 4 * 3), board, || {}).unwrap();
    let EventKind::Log { text, .. } = events.recv().await.unwrap().what else { panic!() };
    assert!(text.contains("a_001.mcap.partial: not repaired: it takes ") && text.contains("; make room and"), "{text}");
    assert!(partial.exists());
}
