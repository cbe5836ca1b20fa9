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

#[test]
fn an_impossible_time_is_replaced() {
    let mut intake = intake(ModalityKind::Bytes, &[]);
    let mut captured = |capture_ns, now| {
        let header = SampleHeader { capture_ns, flags: FLAG_DEVICE_TIME, ..header(Encoding::Bytes) };
        let judged = intake.judge(&header, b"", Stamp(now)).expect("a sample");
        (judged.captured.0, judged.flags & FLAG_DEVICE_TIME != 0, intake.complaint().is_some())
    };
    let s = 1_000_000_000;
    assert_eq!(captured(0, 100 * s), (100 * s, false, false), "not known");
    assert_eq!(captured(101 * s, 102 * s), (101 * s, true, false));
    assert_eq!(captured(u64::MAX, 103 * s), (103 * s, false, true), "the far future");
    assert_eq!(captured(104 * s + 1, 104 * s), (104 * s, false, false), "reported once");
    assert_eq!(captured(1, 105 * s), (105 * s, false, false), "long ago");
    assert_eq!(captured(104 * s, 106 * s), (105 * s, true, false), "never back");
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
                prop_assert_eq!(judged.flags & !3, 0);
            }
        }
    }
}
