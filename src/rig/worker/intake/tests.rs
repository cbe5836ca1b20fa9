use proptest::prelude::*;
use rapid_registry::Opens;

use super::*;

const NOW: Stamp = Stamp(100_000_000_000);

fn intake(kind: ModalityKind, shape: &[u32]) -> Intake {
    let process = ProcessSpec { program: "p".into(), args: Vec::new(), opens: Opens::Usb, kind, shape: shape.to_vec() };
    Intake::new(ModalityId::new(3).expect("below 64"), Epoch(7), &process)
}

fn header(encoding: Encoding) -> SampleHeader {
    SampleHeader { id: 3, epoch: 7, encoding: encoding as u32, capture_ns: NOW.0 - 5, ..SampleHeader::default() }
}

fn complaint(kind: ModalityKind, shape: &[u32], header: SampleHeader, payload: &[u8]) -> String {
    let mut intake = intake(kind, shape);
    assert_eq!(intake.judge(&header, payload, NOW), None);
    let complaint = intake.complaint().expect("a complaint");
    assert_eq!(intake.judge(&header, payload, NOW), None);
    assert_eq!(intake.complaint(), None, "reported once");
    complaint.strip_prefix("samples are refused: ").expect("a refusal").to_owned()
}

#[test]
fn a_repeated_number_makes_duplicates_and_a_counter_that_restarts_does_not() {
    let mut intake = intake(ModalityKind::Bytes, &[]);
    for (seq, is_again, lost) in
        [(0, false, 0), (0, true, 0), (0, true, 0), (1, false, 0), (4, false, 2), (4, true, 0), (0, false, 0)]
    {
        let header = SampleHeader { seq, capture_ns: 0, ..header(Encoding::Bytes) };
        let judged = intake.judge(&header, b"x", NOW).expect("it is passed on");
        assert_eq!((judged.flags & FLAG_SAME_NUMBER != 0, judged.lost), (is_again, lost), "{seq}");
    }
    let complaint = "samples are duplicates, of seq 0 again: a program must count its samples in seq";
    assert_eq!(intake.complaint().as_deref(), Some(complaint));
    assert_eq!(intake.complaint(), None, "reported once");
}

#[test]
fn samples_that_contradict_the_entry_are_rejected_with_a_reason() {
    use Encoding::{Bytes, F64, Grey, Mjpeg, Yuyv};
    use ModalityKind::{Image, Scalars};
    let other = |id, epoch| SampleHeader { id, epoch, ..header(F64) };
    let picture = |encoding, width, height| SampleHeader { width, height, ..header(encoding) };
    let strange = SampleHeader { encoding: 99, ..header(F64) };
    let correct = "correct the program or the entry";
    let table = [
        (
            Scalars,
            &[2][..],
            other(4, 7),
            16,
            "its samples carry modality 4, not 3: a program must send RAPID_BIT as id".into(),
        ),
        (
            Scalars,
            &[2],
            other(3, 6),
            16,
            "its samples carry epoch 6, not 7: a program must send RAPID_EPOCH as epoch".into(),
        ),
        (Scalars, &[2], header(F64), 15, format!("its samples have 15 bytes, not 16: {correct}")),
        (Scalars, &[2], header(Bytes), 16, "its samples have encoding 0, which is none of 4 (f64)".into()),
        (Scalars, &[2], strange, 16, "its samples have encoding 99, which is none of 4 (f64)".into()),
        (Image, &[2, 4], picture(Grey, 4, 2), 9, format!("its samples have 9 bytes, not 8: {correct}")),
        (Image, &[2, 4], picture(Yuyv, 2, 4), 16, format!("its pictures are 2x4, not 4x2: {correct}")),
        (Image, &[2, 4], picture(Mjpeg, 4, 2), 16, "its pictures are not JPEG as they declare".into()),
    ];
    for (kind, shape, header, bytes, expected) in table {
        assert_eq!(complaint(kind, shape, header, &vec![0; bytes]), expected);
    }
}

#[test]
fn samples_that_match_the_entry_are_forwarded() {
    let mut scalars = intake(ModalityKind::Scalars, &[2]);
    let judged = scalars.judge(&SampleHeader { flags: 0xffff, width: 9, ..header(Encoding::F64) }, &[0; 16], NOW);
    let expected =
        Judged { encoding: Encoding::F64, captured: Stamp(NOW.0 - 5), flags: 3, width: 2, height: 0, lost: 0 };
    assert_eq!(judged, Some(expected));
    let mut image = intake(ModalityKind::Image, &[2, 4]);
    let judged = image.judge(&header(Encoding::Mjpeg), b"\xff\xd8", NOW).expect("a picture");
    assert_eq!((judged.width, judged.height), (4, 2));
    assert!(image.judge(&header(Encoding::Grey), &[0; 8], NOW).is_some());
    assert!(image.judge(&header(Encoding::Yuyv), &[0; 16], NOW).is_some());
    assert!(intake(ModalityKind::Bytes, &[]).judge(&header(Encoding::Bytes), b"", NOW).is_some());
}

/// What becomes of a capture time.
#[derive(Debug, PartialEq)]
enum Becomes {
    /// The sample is good, with this stamp of the device's.
    Good(u64),
    /// The program does not know when; the sample is good, with the time of its arrival.
    Arrival,
    /// It is damaged, with this estimate.
    Damaged(u64),
}

#[test]
fn an_impossible_time_is_damaged_and_decides_for_its_sample_alone() {
    use Becomes::{Arrival, Damaged, Good};
    const S: u64 = 1_000_000_000;
    const MS: u64 = 1_000_000;
    // Capture time, arrival, what it becomes, and whether it is complained about.
    let table = [
        (0, 100 * S, Arrival, false),
        (101 * S, 102 * S, Good(101 * S), false),
        // The far future; reported once. The one before took a second.
        (u64::MAX, 103 * S, Damaged(102 * S), true),
        (104 * S + 1, 104 * S, Damaged(103 * S), false),
        // Long ago, and the origin of another clock.
        (92 * S, 105 * S, Damaged(104 * S), false),
        (1, 105 * S, Damaged(104 * S), false),
        // The next one is as good as ever; also directly after an estimate that was too late.
        (104 * S + 100 * MS, 105 * S + 100 * MS, Good(104 * S + 100 * MS), false),
        (u64::MAX, 105 * S + 200 * MS, Damaged(104 * S + 200 * MS), false),
        (104 * S + 190 * MS, 105 * S + 250 * MS, Good(104 * S + 200 * MS + 1), false),
        // Back, before one that was believed.
        (104 * S, 105 * S + 300 * MS, Damaged(104 * S + 240 * MS), false),
        // As late as is believed, which is for the verdict.
        (106 * S, 116 * S, Good(106 * S), false),
        (106 * S + 1, 116 * S + 2, Damaged(106 * S + 2), false),
    ];
    let mut intake = intake(ModalityKind::Bytes, &[]);
    for (seq, (capture_ns, now, expected, complains)) in (0..).zip(table) {
        let header = SampleHeader { seq, capture_ns, flags: FLAG_DEVICE_TIME, ..header(Encoding::Bytes) };
        let judged = intake.judge(&header, b"", Stamp(now)).expect("a sample");
        let found = match judged.flags {
            0 if judged.captured.0 == now => Arrival,
            FLAG_DEVICE_TIME => Good(judged.captured.0),
            FLAG_ERROR => Damaged(judged.captured.0),
            other => panic!("{other}"),
        };
        assert_eq!(found, expected, "{capture_ns} at {now}");
        let complaint = intake.complaint();
        assert_eq!(complaint.is_some(), complains, "{complaint:?}");
    }
}

#[test]
fn a_capture_time_that_is_not_believed_is_named_with_the_fix() {
    let fix = "send CLOCK_MONOTONIC, or 0 if it is not known";
    let table = [
        (NOW.0 + 2_500_000_000, "2.5s in the future"),
        (NOW.0 - 12_000_000_000, "12s old"),
        (NOW.0 - 1_005_000_000, "1s before the one before"),
    ];
    for (capture_ns, doubt) in table {
        let mut intake = intake(ModalityKind::Bytes, &[]);
        // Each has another number.
        let mut judge = |capture_ns| {
            intake
                .judge(&SampleHeader { seq: capture_ns, capture_ns, ..header(Encoding::Bytes) }, b"", NOW)
                .expect("a sample");
            intake.complaint()
        };
        assert_eq!(judge(NOW.0 - 5_000_000), None);
        let expected = format!("samples are damaged, by a capture time that is {doubt}: {fix}");
        assert_eq!(judge(capture_ns), Some(expected));
    }
}

#[test]
fn gaps_are_counted_and_jumps_are_not() {
    let mut intake = intake(ModalityKind::Bytes, &[]);
    let mut lost = |seq| {
        let header = SampleHeader { seq, ..header(Encoding::Bytes) };
        intake.judge(&header, b"", NOW).expect("a sample").lost
    };
    let seqs = [5, 6, 9, 9, 2, 3, u64::MAX, 0, 1_000_001, 2_000_003];
    assert_eq!(seqs.map(&mut lost), [0, 0, 2, 0, 0, 0, 0, 0, 1_000_000, 0]);
}

proptest! {
    #[test]
    fn no_header_passes_an_impossible_number(
        words: [u64; 4], fields: [u32; 6], valid: bool, bytes in 0..64_usize, kind in 0..3_usize, now: u64,
    ) {
        let kinds = [
            (ModalityKind::Scalars, &[4][..]), (ModalityKind::Image, &[2, 4]), (ModalityKind::Bytes, &[]),
        ];
        let (kind, shape) = kinds[kind];
        let mut intake = intake(kind, shape);
        let [seq, lost, capture_ns, recv_ns] = words;
        let [id, epoch, encoding, flags, width, height] = fields;
        let (id, epoch, encoding) = if valid { (3, 7, encoding % 7) } else { (id, epoch, encoding) };
        let header = SampleHeader { seq, lost, capture_ns, recv_ns, id, epoch, encoding, flags, width, height };
        for _ in 0..2 {
            if let Some(judged) = intake.judge(&header, &vec![0; bytes], Stamp(now)) {
                prop_assert!(header.id == 3 && header.epoch == 7);
                prop_assert!(judged.captured <= Stamp(now) && judged.lost <= LARGEST_HOLE);
                prop_assert!(judged.width <= 4 && judged.height <= 2);
                prop_assert_eq!(judged.flags & !7, 0);
                // A later sample is never made an earlier one.
                let is_damaged = judged.flags & FLAG_ERROR != 0;
                prop_assert!(is_damaged || capture_ns == 0 || judged.captured == Stamp(capture_ns));
            }
        }
    }
}
