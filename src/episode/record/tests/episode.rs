//! Whole episodes: what is in the file, and when.

use super::*;

#[tokio::test]
async fn an_episode_holds_exactly_the_captured_samples() {
    let mut bench = Bench::new();
    let mut events = bench.board.events();
    let (finished, t0) = bench.one_second().await;
    let EventKind::Episode(EpisodeReport { file, seconds, messages, bytes, dropped, error, verdict }) =
        bench.until_closed(&mut events).await
    else {
        unreachable!()
    };
    assert_eq!((file.as_path(), error, seconds), (finished.as_path(), None, 1.0));
    // The camera was away by the mask; everything else is reported.
    let reasons = ["tof: 1 of 1", "tof: 7 of 1", "raw: 1 of 2 samples damaged (limit 5 %)", "raw: no sample for "];
    assert_eq!(verdict.grade, Grade::Bad);
    for reason in reasons {
        assert!(verdict.reasons.iter().any(|answer| answer.starts_with(reason)), "{reason:?} in {:?}", verdict.reasons);
    }
    assert_eq!(verdict.reasons.len(), reasons.len(), "{:?}", verdict.reasons);
    assert_eq!(bytes, std::fs::metadata(&finished).unwrap().len());
    assert!(!finished.with_extension("mcap.partial").exists());
    let snapshot = bench.board.snapshot();
    assert_eq!((snapshot.recording, snapshot.last_episode), (None, Some(finished.clone())));

    let read = read(&finished);
    let stats = read.summary.stats.as_ref().unwrap();
    assert_eq!(stats.message_count, messages);
    assert_eq!(read.attachments["devices.toml"], registry().text.as_bytes());
    let about = &read.metadata["rapid"];
    assert_eq!(about["layout"], r#"{"cam_wrist":0,"never":5,"raw":7,"tof":1}"#);
    assert_eq!((about["task"].as_str(), about["tags"].as_str()), ("place block", r#"{"finger":"soft"}"#));
    assert_eq!((about["rig"].as_str(), about["sync_window_ns"].as_str()), ("bench", "25000000"));
    assert_eq!(about["registry"], registry().text);
    let begin: u64 = about["begin_wall_ns"].parse().unwrap();
    let end = begin + 1000 * MS;

    // Every channel is named, one that never sent too, by the schema its device lets expect.
    let channels: BTreeMap<_, _> =
        read.summary.channels.values().map(|c| (c.topic.as_str(), c.schema.as_ref().unwrap().name.as_str())).collect();
    let expected = BTreeMap::from([
        ("/rapid/cam_wrist", "foxglove.CompressedImage"),
        ("/rapid/event", "rapid.Event"),
        ("/rapid/frame", "rapid.Frame"),
        ("/rapid/log", "foxglove.Log"),
        ("/rapid/mask", "rapid.Mask"),
        ("/rapid/never", "foxglove.RawImage"),
        ("/rapid/raw", "foxglove.RawImage"),
        ("/rapid/tof", "rapid.Scalars"),
    ]);
    assert_eq!(channels, expected);
    let never = read.summary.channels.values().find(|c| c.topic == "/rapid/never").unwrap();
    assert_eq!((never.metadata["bit"].as_str(), never.metadata["kind"].as_str()), ("5", "image"));

    // Samples: those captured before the end, in order, with their times.
    let mut written = 0;
    for (topic, message) in read.messages.iter().map(|m| (m.0.as_str(), m)) {
        if ["/rapid/cam_wrist", "/rapid/tof", "/rapid/raw"].contains(&topic) {
            assert!((begin..end).contains(&message.2));
            assert_eq!(message.3 - message.2, 5 * MS);
            written += 1;
        }
    }
    let tof: Vec<u32> = read.on("/rapid/tof").map(|m| m.1).collect();
    assert_eq!(tof.len() + read.on("/rapid/cam_wrist").count() + 2, written);
    let late = t0.since(Stamp(about["begin_monotonic_ns"].parse().unwrap()));
    let in_time = |n: &u64| *n != 20 && late + Duration::from_millis(n * 10) < Duration::from_secs(1);
    assert_eq!(tof.len(), (0..100).filter(in_time).count());
    assert!(tof.is_sorted() && tof[0] == 101);
    let values = read.on("/rapid/tof").next().unwrap().4.get_field_by_name("values").unwrap().into_owned();
    assert_eq!(values.as_list().unwrap().iter().map(|v| v.as_f64().unwrap()).collect::<Vec<_>>(), [101.0, 0.5]);
    let cam = read.on("/rapid/cam_wrist").nth(3).unwrap();
    let data = cam.4.get_field_by_name("data").unwrap().as_bytes().unwrap().to_vec();
    assert_eq!(data, picture(u64::from(cam.1)));
    assert_eq!([text(&cam.4, "format"), text(&cam.4, "frame_id")], ["jpeg", "cam_wrist"]);

    // Losses: seven of the device's own and one on the way.
    assert_eq!(dropped, 1);
    let summary = &read.metadata["rapid/summary"];
    let tallies: serde_json::Value = serde_json::from_str(&summary["modalities"]).unwrap();
    assert_eq!((&tallies["tof"]["lost"], &tallies["tof"]["dropped"]), (&7.into(), &1.into()));
    assert_eq!((&tallies["cam_wrist"]["lost"], &tallies["cam_wrist"]["dropped"]), (&0.into(), &0.into()));
    assert_eq!((&tallies["raw"]["damaged"], &tallies["raw"]["samples"]), (&1.into(), &2.into()));
    assert_eq!(tallies["never"]["samples"], 0);
    assert_eq!((summary["dropped"].as_str(), summary["serials"].as_str()), ("1", r#"{"raw":"S7"}"#));
    assert_eq!((summary["duration_s"].as_str(), summary["lost"].as_str()), ("1", "7"));

    // The mask: first the one in force before the beginning, then every edge at its time.
    let masks: Vec<(u64, i128)> = read.on("/rapid/mask").map(|m| (m.2, number(&m.4, "mask"))).collect();
    assert!(masks[0].0 < begin && masks[1].0 >= begin);
    let edges: Vec<i128> = masks.windows(2).filter(|w| w[0].1 != w[1].1).map(|w| w[1].1).collect();
    assert_eq!(edges, [0b1000_0011, 0b1000_0010, 0b1000_0011]);

    // Events: in the file as they were announced, with the log line in its own channel too. The recorder's own lines
    // about losses come when they come.
    let events: Vec<_> = read.on("/rapid/event").filter(|m| !text(&m.4, "text").contains("lost")).collect();
    let kinds: Vec<String> = events.iter().map(|m| text(&m.4, "kind")).collect();
    assert!(kinds.starts_with(&["recording".into(), "attach".into(), "log".into()]), "{kinds:?}");
    let attach = &events[1].4;
    assert_eq!((text(attach, "device"), text(attach, "text").contains("S7")), ("raw".to_owned(), true));
    let json: serde_json::Value = serde_json::from_str(&text(attach, "json")).unwrap();
    assert_eq!((&json["event"], &json["serial"]), (&"attach".into(), &"S7".into()));
    let lines: Vec<String> = read.on("/rapid/log").map(|m| text(&m.4, "message")).collect();
    assert!(lines.iter().any(|line| line == "hello"), "{lines:?}");
    assert!(lines.iter().any(|line| line.starts_with("tof: ") && line.contains("lost")), "{lines:?}");

    check_frames(&read, begin);
}

/// Chooses the sample of each frame again from nothing but the file.
fn check_frames(read: &Read, begin: u64) {
    let frames: Vec<_> = read.on("/rapid/frame").collect();
    assert_eq!(frames.len(), 30);
    let mut seen = BTreeMap::new();
    for (index, (_, sequence, tick, deadline, frame)) in frames.into_iter().enumerate() {
        assert_eq!((*sequence as usize, number(frame, "index")), (index, index as i128));
        assert_eq!(*tick, begin + index as u64 * 1_000_000_000 / 30);
        assert_eq!(deadline - tick, 125 * MS);
        let mask = read.on("/rapid/mask").filter(|m| m.2 <= *tick).last().map(|m| number(&m.4, "mask")).unwrap();
        assert_eq!(number(frame, "mask"), mask);
        let list = frame.get_field_by_name("modalities").unwrap();
        let list = list.as_list().unwrap();
        assert_eq!(list.len(), 4);
        for (slot, topic) in list.iter().zip(["/rapid/cam_wrist", "/rapid/tof", "/rapid/never", "/rapid/raw"]) {
            let slot = slot.as_message().unwrap();
            let present = mask >> number(slot, "bit") & 1;
            // Of the camera's two attachments only the newer one counts, from the first sample on that
            // it has in the window.
            let mut known: Vec<_> = read
                .on(topic)
                .filter(|m| m.3 <= *deadline && !(topic == "/rapid/raw" && m.1 == 1))
                .map(|m| (m.2.abs_diff(*tick), m.2, m.1))
                .collect();
            if topic == "/rapid/cam_wrist" && known.iter().any(|k| k.2 >= 10 && k.1 <= tick + 25 * MS) {
                known.retain(|k| k.2 >= 10);
            }
            let nearest = known.iter().filter(|k| k.0 <= 25 * MS).min().copied();
            let held = known.iter().filter(|k| k.1 <= *tick).max_by_key(|k| k.1).copied();
            let chosen = if present == 1 { nearest.or(held) } else { None };
            let valid = present == 1 && nearest.is_some();
            let answer = ["present", "valid", "stale"].map(|flag| number(slot, flag) == 1);
            assert_eq!(answer, [present == 1, valid, present == 1 && !valid], "{topic} in frame {index}");
            let seq = slot.has_field_by_name("seq").then(|| number(slot, "seq"));
            assert_eq!(seq, chosen.map(|c| c.2.into()), "{topic} in frame {index}");
            let age = chosen.map_or(0, |c| i128::from(*tick) - i128::from(c.1));
            assert_eq!(number(slot, "age_ns"), age);
            *seen.entry((topic, answer)).or_insert(0) += 1;
        }
    }
    // The script makes each case happen.
    let count = |topic, answer| seen.get(&(topic, answer)).copied().unwrap_or(0);
    assert!(count("/rapid/cam_wrist", [true, true, false]) > 10);
    assert!(count("/rapid/cam_wrist", [false, false, false]) > 7);
    assert_eq!(count("/rapid/never", [false, false, false]), 30);
    assert!(count("/rapid/raw", [true, false, true]) > 10);
    assert!(count("/rapid/raw", [true, true, false]) > 0);
}

#[tokio::test]
async fn commands_out_of_order_are_refused_and_a_stop_returns_a_report() {
    let mut bench = Bench::new();
    assert_eq!(bench.recorder.stop().await, None);
    let missing = EpisodeRequest { out: bench.folder.path().join("a/b/c"), ..bench.request(None) };
    assert!(matches!(bench.recorder.start(missing).await, Err(RecordError::NoFolder(_))));
    let first = bench.recorder.start(bench.request(None)).await.unwrap();
    assert!(matches!(bench.recorder.start(bench.request(None)).await, Err(RecordError::Busy(file)) if file == first));
    assert_eq!(bench.board.snapshot().recording.unwrap().file, first);
    let captured = Stamp::now();
    bench.sample(TOF, 1, 0, captured.0, 0);
    while Stamp::now() <= captured {}
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!((report.file.as_path(), report.error, report.dropped), (first.as_path(), None, 0));
    assert!(report.seconds > 0.0 && read(&first).on("/rapid/tof").count() == 1);
    let second = bench.recorder.start(bench.request(None)).await.unwrap();
    assert!(second.to_str().unwrap().ends_with("_place-block_002.mcap"));
    // The handle's end is the episode's end.
    let Bench { recorder, folder, .. } = bench;
    drop(recorder);
    assert!(read(&second).metadata["rapid/summary"]["frames"].parse::<u64>().is_ok());
    drop(folder);
}

#[tokio::test]
async fn unexpected_payloads_are_recorded_as_bytes_and_never_lost() {
    let mut bench = Bench::new();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let now = Stamp::now().0;
    let header = SampleHeader { seq: 0, capture_ns: now, recv_ns: now, epoch: 1, encoding: 99, ..Default::default() };
    bench.script.put((TopicId::Modality(id(CAM)), header, b"??".to_vec()));
    let header = SampleHeader { seq: u64::MAX, encoding: Encoding::F64 as u32, ..header };
    bench.script.put((TopicId::Modality(id(TOF)), header, b"12345".to_vec()));
    let header = SampleHeader { seq: 3, encoding: Encoding::F64 as u32, ..header };
    bench.script.put((TopicId::Modality(id(TOF)), header, b"12345678".to_vec()));
    bench.script.put((TopicId::Modality(id(40)), header, b"not registered".to_vec()));
    bench.script.put((TopicId::Mask, header, b"short".to_vec()));
    while Stamp::now().0 <= now {}
    assert_eq!(bench.recorder.stop().await.unwrap().error, None);
    let read = read(&finished);
    let data = |topic: &str| -> Vec<(String, Vec<u8>)> {
        let with_data = read.on(topic).filter(|m| m.4.descriptor().get_field_by_name("data").is_some());
        with_data
            .map(|m| {
                let data = m.4.get_field_by_name("data").unwrap().as_bytes().unwrap().to_vec();
                (m.4.descriptor().full_name().to_owned(), data)
            })
            .collect()
    };
    assert_eq!(data("/rapid/cam_wrist"), [("rapid.Bytes".to_owned(), b"??".to_vec())]);
    assert_eq!(data("/rapid/tof"), [("rapid.Bytes".to_owned(), b"12345".to_vec())]);
    assert_eq!(read.on("/rapid/tof").count(), 2);
    assert_eq!(read.on("/rapid/mask").count(), 0);
}
