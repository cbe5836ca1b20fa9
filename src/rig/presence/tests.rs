use super::*;
use std::sync::atomic::AtomicU32;

/// A path of this test's own in shared memory.
fn path() -> PathBuf {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    PathBuf::from(format!("/dev/shm/rapid_test_mask_{}_{number}", std::process::id()))
}

#[test]
fn a_published_mask_is_read_back_until_its_publisher_ends() {
    let path = path();
    let mut file = MaskFile::create(&path, 3).expect("create");
    assert!(matches!(read_mask(&path), Err(PresenceError::Starting { .. })), "no mask was published yet");
    for round in 1..=5 {
        file.publish(PhysicalMask(round), 1_000 + round).expect("publish");
        let record = read_mask(&path).expect("read");
        assert_eq!((record.mask.0, record.sequence, record.realtime_ns), (round, round, 1_000 + round));
        assert_eq!((record.device_count, record.generation % 2), (3, 0));
    }
    assert_eq!(std::fs::metadata(&path).expect("file").len(), 32);
    drop(file);
    assert!(matches!(read_mask(&path), Err(PresenceError::NotPublished { .. })));
}

#[test]
fn a_removed_or_replaced_file_is_recreated_and_foreign_files_are_kept() {
    let path = path();
    let mut file = MaskFile::create(&path, 1).expect("create");
    assert!(!file.restore().expect("it is there"));
    for replace in [false, true] {
        std::fs::remove_file(&path).expect("removed");
        if replace {
            std::fs::write(&path, "something").expect("replaced");
        }
        assert!(file.restore().expect("it may be made"));
        file.publish(PhysicalMask(5), 1).expect("publish");
        assert_eq!(read_mask(&path).expect("a whole record").mask.0, 5);
    }
    std::fs::remove_file(&path).expect("removed");
    std::fs::create_dir(&path).expect("replaced");
    assert!(file.restore().expect_err("a folder").to_string().contains("it is a folder"));
    drop(file);
    std::fs::remove_dir(&path).expect("it is not ours to remove");
}

#[test]
fn a_second_publisher_gets_the_pid_of_the_first() {
    let path = path();
    let _first = MaskFile::create(&path, 1).expect("first");
    let error = MaskFile::create(&path, 1).expect_err("second");
    assert!(error.to_string().contains(&format!("(pid {})", std::process::id())), "{error}");
}

#[test]
fn a_file_that_may_not_be_opened_is_explained() {
    let path = path();
    let first = MaskFile::create(&path, 1).expect("first");
    let error = file::refused(&path, rustix::io::Errno::ACCESS);
    assert!(matches!(error, PresenceError::Taken { pid: Some(pid), .. } if pid == std::process::id()), "{error}");
    drop(first);
    std::fs::write(&path, "").expect("leftover");
    // Only root can give a file away.
    if std::os::unix::fs::chown(&path, Some(12_345), None).is_ok() {
        let error = file::refused(&path, rustix::io::Errno::ACCESS);
        assert!(
            error.to_string().contains("user 12345: another user's rapid left it behind; remove it: rm -r "),
            "{error}"
        );
    }
    std::fs::remove_file(&path).expect("clean");
    assert!(matches!(file::refused(&path, rustix::io::Errno::ACCESS), PresenceError::Io { .. }));
}

#[test]
fn the_file_of_a_dead_process_is_taken_over() {
    let path = path();
    std::fs::write(&path, [0xff; 7]).expect("leftover");
    let mut file = MaskFile::create(&path, 1).expect("take over");
    file.publish(PhysicalMask(1), 1).expect("publish");
    assert_eq!(read_mask(&path).expect("read").sequence, 1);
}

#[test]
fn links_are_not_followed() {
    let (path, target) = (path(), path());
    std::fs::write(&target, "precious").expect("target");
    std::os::unix::fs::symlink(&target, &path).expect("link");
    let error = MaskFile::create(&path, 1).expect_err("link");
    assert!(matches!(error, PresenceError::Foreign { .. }), "{error}");
    assert_eq!(std::fs::read_to_string(&target).expect("target"), "precious");
    std::fs::remove_file(&path).expect("clean");
    std::fs::hard_link(&target, &path).expect("hard link");
    assert!(matches!(MaskFile::create(&path, 1), Err(PresenceError::Foreign { .. })));
    assert_eq!(std::fs::read_to_string(&target).expect("target"), "precious");
    std::fs::remove_file(&path).expect("clean");
    std::fs::remove_file(&target).expect("clean");
}

#[test]
fn files_planted_by_others_are_named_and_neither_waited_for_nor_written_to() {
    let (path, victim) = (path(), path());
    let json = json_path(&path);
    std::fs::write(&victim, "precious").expect("victim");
    let pipe = |path: &Path| {
        rustix::fs::mknodat(rustix::fs::CWD, path, rustix::fs::FileType::Fifo, 0o666.into(), 0).expect("pipe");
    };
    let refused = |path: &Path, error: PresenceError| {
        let report = error.to_string();
        assert!(matches!(error, PresenceError::Foreign { .. }), "{report}");
        assert!(report.ends_with(&format!("remove it: rm -r {}", path.display())), "{report}");
    };
    pipe(&path);
    refused(&path, Claim::new(&path, 1).expect_err("a pipe as the mask"));
    refused(&path, read_mask(&path).expect_err("a pipe as the mask"));
    std::fs::remove_file(&path).expect("clean");
    std::os::unix::fs::symlink(&victim, &path).expect("link");
    refused(&path, read_mask(&path).expect_err("a link as the mask"));
    std::fs::remove_file(&path).expect("clean");
    for plant in [pipe as fn(&Path), |path| std::fs::create_dir(path).expect("folder")] {
        plant(&json);
        refused(&json, Claim::new(&path, 1).expect_err("something as the JSON file"));
        assert!(!path.exists(), "the mask was made all the same");
        std::fs::remove_file(&json).or_else(|_| std::fs::remove_dir(&json)).expect("clean");
    }
    // After the claim: a link is replaced, and its target is not touched.
    let _claim = Claim::new(&path, 1).expect("claim");
    std::os::unix::fs::symlink(&victim, &json).expect("link");
    json::write(&json, PhysicalMask(0), 1, &[]).expect("write");
    assert!(!json.is_symlink());
    assert_eq!(std::fs::read_to_string(&victim).expect("victim"), "precious");
    for path in [&json, &victim] {
        std::fs::remove_file(path).expect("clean");
    }
}

#[test]
fn files_of_another_user_are_not_published_through() {
    let path = path();
    let json = json_path(&path);
    for planted in [&path, &json] {
        std::fs::write(planted, "").expect("plant");
        std::fs::set_permissions(planted, std::os::unix::fs::PermissionsExt::from_mode(0o666)).expect("mode");
        if std::os::unix::fs::chown(planted, Some(12_345), None).is_err() {
            crate::skip::skipped("only root can give files away");
            std::fs::remove_file(planted).expect("clean");
            return;
        }
        let error = Claim::new(&path, 1).expect_err("another user's file").to_string();
        assert!(error.starts_with(&format!("{}: it belongs to user 12345", planted.display())), "{error}");
        std::fs::remove_file(planted).expect("clean");
    }
}

#[test]
fn a_reader_never_sees_a_torn_record() {
    let path = path();
    let mut file = MaskFile::create(&path, 64).expect("create");
    file.publish(PhysicalMask(1), 1).expect("publish");
    let done = Arc::new(AtomicBool::new(false));
    let reader = std::thread::spawn({
        let (path, done) = (path.clone(), Arc::clone(&done));
        move || {
            let mut seen = 0_u32;
            while !done.load(Ordering::Relaxed) {
                // A writer without a pause may be in the middle of a write at every look of a reader on a busy machine.
                let record = match read_mask(&path) {
                    Err(PresenceError::Torn { .. }) => continue,
                    read => read.expect("read"),
                };
                assert_eq!((record.mask.0, record.realtime_ns), (record.sequence, record.sequence));
                seen += 1;
            }
            seen
        }
    });
    for value in 2..200_000 {
        file.publish(PhysicalMask(value), value).expect("publish");
    }
    done.store(true, Ordering::Relaxed);
    assert!(reader.join().expect("no torn record") > 0);
}

#[test]
fn the_json_document_has_the_papers_fields() {
    let path = json_path(&path());
    let bit = rapid_core::modality::ModalityId::new(0).expect("below 64");
    let device = JsonDevice {
        name: "cam".into(),
        bit,
        online: true,
        usb_connected: true,
        state: rapid_status::DeviceState::Streaming,
    };
    json::write(&path, PhysicalMask(1), 9, &[device]).expect("write");
    let document: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).expect("file")).expect("json");
    std::fs::remove_file(&path).expect("clean");
    assert_eq!(document["mask"], "0x01");
    assert_eq!(document["mask_binary"], "00000001");
    assert_eq!((&document["device_count"], &document["online_count"]), (&1.into(), &1.into()));
    assert_eq!(document["sequence"], 9);
    assert_eq!(document["devices"][0]["name"], "cam");
    assert_eq!(document["devices"][0]["usb_connected"], true);
    let timestamp = document["timestamp"].as_str().expect("text");
    assert!(timestamp.starts_with("20") && timestamp.ends_with('Z'), "{timestamp}");
}

#[test]
fn an_incomplete_mask_is_named_with_its_cause() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("mask");
    for bytes in [0, 1, rapid_core::mask::RECORD_LEN / 2, rapid_core::mask::RECORD_LEN - 1] {
        std::fs::write(&path, vec![0; bytes]).expect("write");
        let report = read_mask(&path).expect_err("a part of a mask").to_string();
        let name = path.display().to_string();
        assert!(
            report.starts_with(&name) && report.contains("only part of a mask is there"),
            "{bytes} bytes: {report}"
        );
    }
}

#[test]
fn masks_of_other_names_are_found_while_they_are_published() {
    let unnamed = path();
    let of = |name: &str| PathBuf::from(format!("{}.{name}", unnamed.display()));
    assert_eq!(instances(&unnamed), Vec::<String>::new());
    let files = [of("left"), of("arm.2"), unnamed.clone()].map(|path| MaskFile::create(&path, 1).expect("create"));
    // Left behind by a killed process.
    std::fs::write(of("dead"), [0; 32]).expect("written");
    assert_eq!(instances(&unnamed), ["", "arm.2", "left"]);
    drop(files);
    assert_eq!(instances(&unnamed), Vec::<String>::new());
    std::fs::remove_file(of("dead")).expect("removed");
}
