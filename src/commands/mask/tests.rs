use std::cell::Cell;

use super::*;

const NOW: u64 = 1_700_000_000_123_000_000;
const TEXT: MaskOptions = MaskOptions { watch: true, json: false, palette: Palette::Plain };

fn record(mask: u64, sequence: u64, realtime_ns: u64) -> MaskRecord {
    MaskRecord { device_count: 3, generation: 0, mask: PhysicalMask(mask), realtime_ns, sequence }
}

fn names() -> Vec<(u8, String)> {
    vec![(0, "cam_wrist".to_owned()), (1, "cam_top".to_owned()), (2, "tof\x1b[2J".to_owned())]
}

#[test]
fn the_mask_is_shown_with_names_and_age() {
    let text = render(&record(5, 42, NOW - 1_500_000), Some(&names()), NOW, Palette::Plain);
    insta::assert_snapshot!(text, @r#"
    mask 0x05  00000101  2 of 3 present  sequence 42  1 ms old
      bit  0  cam_wrist             present
      bit  1  cam_top               absent
      bit  2  tof [2J               present
    "#);
    // Without names, by number; a bit beyond the count is not hidden.
    let text = render(&record(0b1000, 42, NOW - 3_200_000_000), None, NOW, Palette::Plain);
    insta::assert_snapshot!(text, @r#"
    mask 0x08  00001000  1 of 3 present  sequence 42  stale: published 3.2 s ago, the publisher is stopped or gone
      bit  0  ?                     absent
      bit  1  ?                     absent
      bit  2  ?                     absent
      bit  3  ?                     present
    "#);
}

#[test]
fn json_contains_the_same_data() {
    let text = render_json(&record(5, 42, NOW - 1_500_000), Some(&names()), NOW).unwrap();
    let object: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(object["mask"], "0x05");
    assert_eq!(object["mask_binary"], "00000101");
    assert_eq!(object["online_count"], 2);
    assert_eq!(object["sequence"], 42);
    assert_eq!(object["age_ms"], 1.5);
    assert_eq!(object["stale"], false);
    assert_eq!(object["devices"][1]["online"], false);
    assert_eq!(object["time"], "2023-11-14T22:13:20.121Z");
    // After the clock is set back an age is not negative.
    assert!(render_json(&record(5, 42, NOW + 5), None, NOW).unwrap().contains("\"age_ms\":0.0"));
}

#[test]
fn names_come_from_the_published_json() {
    let json = r#"{"timestamp":1.5,"devices":[{"name":"cam","bit":3,"online":true,"state":"streaming"}]}"#;
    assert_eq!(layout(json), Some(vec![(3, "cam".to_owned())]));
    assert_eq!(layout("{"), None);
    assert_eq!(layout("{}"), None);
}

#[tokio::test(start_paused = true)]
async fn a_watch_prints_changes_and_the_publishers_end_and_return() {
    let look = Cell::new(0_u64);
    let stop = CancellationToken::new();
    let read = || {
        look.set(look.get() + 1);
        let at = NOW + look.get() * 2_000_000;
        match look.get() {
            1..=3 => Ok(record(0, look.get(), at)),
            4..=6 => Ok(record(1, look.get(), at)),
            7 => Ok(record(6, 7, at)),
            8..=9 => Err("no such file".to_owned()),
            // A new publisher begins to count from 1, with the same mask.
            10..=12 => Ok(record(6, look.get() - 9, at)),
            _ => {
                stop.cancel();
                Err("no such file".to_owned())
            }
        }
    };
    let mut out = Vec::new();
    run(read, || Some(names()), || NOW + look.get() * 2_000_000, TEXT, stop.clone(), &mut out).await.unwrap();
    insta::assert_snapshot!(String::from_utf8(out).unwrap(), @r#"
    mask 0x00  00000000  0 of 3 present  sequence 1  0 ms old
      bit  0  cam_wrist             absent
      bit  1  cam_top               absent
      bit  2  tof [2J               absent
    22:13:20.131Z  0x01  00000001  +cam_wrist
    22:13:20.137Z  0x06  00000110  -cam_wrist +cam_top +tof [2J
    22:13:20.139Z  the publisher is gone: no such file
    22:13:20.143Z  0x06  00000110  the publisher is back
    22:13:20.149Z  the publisher is gone: no such file
    "#);
}

#[tokio::test(start_paused = true)]
async fn a_publisher_that_stopped_publishing_is_reported_as_gone() {
    let look = Cell::new(0_u64);
    let stop = CancellationToken::new();
    let read = || {
        look.set(look.get() + 1);
        if look.get() == 1000 {
            stop.cancel();
        }
        Ok(record(1, 1, NOW))
    };
    let mut out = Vec::new();
    let options = MaskOptions { json: true, ..TEXT };
    run(read, || None, || NOW + look.get() * 2_000_000, options, stop.clone(), &mut out).await.unwrap();
    let out = String::from_utf8(out).unwrap();
    let lines: Vec<serde_json::Value> = out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 2, "{out}");
    assert_eq!(lines[0]["mask"], "0x01");
    assert_eq!(lines[1]["gone"], "the publisher is gone: no publication for 1 s");
}

#[tokio::test]
async fn without_a_record_the_reason_is_the_error() {
    let read = || Err("/dev/shm/rapid_hardware_mask: no such file; is rapid running?".to_owned());
    let error = run(read, || None, || NOW, TEXT, CancellationToken::new(), Vec::new()).await.unwrap_err();
    assert!(matches!(error, MaskError::Unreadable(_)), "{error}");
}

#[tokio::test]
async fn a_closed_pipe_is_a_clean_end() {
    let (reader, writer) = io::pipe().unwrap();
    drop(reader);
    run(|| Ok(record(1, 1, NOW)), || None, || NOW, TEXT, CancellationToken::new(), writer).await.unwrap();
}
