//! Pictures of whole, damaged and hostile files: well-formed, closed to the outside, and bounded.

use std::path::Path;

use proptest::prelude::*;
use rapid_core::modality::ModalityId;
use rapid_status::session::{Label, Notes};
use rapid_status::{Grade, Verdict};
use roxmltree::Document;

use super::gather::{BINS, Mark, PICTURES, Row, Subject};
use super::thumbnail::Thumbnail;
use super::*;
use crate::record::inspect::{MaskEdge, ModalityReport, TopicReport};
use crate::testing;

const HOSTILE: &str = "</text><script>alert(1)</script> \"'&\u{0}\u{1b}[2J\u{202e}\u{ffff}";

/// The picture of a file of these bytes.
fn plot_of(bytes: &[u8]) -> Result<Plot, ReadError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.mcap");
    std::fs::write(&path, bytes).unwrap();
    plot(&path, None)
}

/// Checks that a picture is XML, with no script and nothing from outside.
#[track_caller]
fn checked(svg: &str) -> Document<'_> {
    assert!(svg.starts_with(BEGINNING));
    let document = Document::parse(svg).unwrap_or_else(|error| panic!("{error}: {svg}"));
    let known = ["svg", "style", "defs", "pattern", "rect", "path", "text", "title", "image"];
    for element in document.descendants().filter(roxmltree::Node::is_element) {
        assert!(known.contains(&element.tag_name().name()), "{:?}", element.tag_name());
        for attribute in element.attributes() {
            assert!(!attribute.name().starts_with("on"), "{attribute:?}");
            let is_inside = attribute.name() != "href" || attribute.value().starts_with("data:image/jpeg;base64,");
            assert!(is_inside && !attribute.value().contains("NaN"), "{attribute:?}");
        }
    }
    document
}

fn row() -> Row {
    let picture = || Thumbnail { share: 0.5, aspect: 1.5, jpeg: vec![0xff; 6000] };
    let mut row = Row::new(HOSTILE.to_owned());
    (row.samples, row.missing) = (vec![3; BINS], vec![1; BINS]);
    (row.present, row.stale) = (vec![3; BINS], (0..BINS).map(|bin| u32::from(bin % 2 == 0)).collect());
    row.pictures = [const { None }; PICTURES].map(|_: Option<Thumbnail>| Some(picture()));
    row
}

/// A modality whose device is plugged in and out all the time.
fn flapping(bit: u8) -> ModalityReport {
    let topic = TopicReport {
        topic: HOSTILE.to_owned(),
        messages: 9,
        hz: f64::MAX,
        missing: u64::MAX,
        longest_gap: 1e300,
        lateness: None,
    };
    ModalityReport {
        name: HOSTILE.repeat(50),
        bit,
        topic,
        presence: Some(0.5),
        present: (0..5000).map(|at| (f64::from(at) * 0.72, f64::from(at) * 0.72 + 0.36)).collect(),
        frames_valid: 0,
        frames_stale: 0,
        quality: None,
    }
}

#[test]
fn the_picture_is_bounded_and_escaped_whatever_is_in_the_file() {
    let mut report = inspect::inspect_bytes(&testing::episode(testing::options())).unwrap();
    (report.file, report.seconds) = (Path::new(&HOSTILE.replace('/', "")).to_owned(), 3600.0);
    report.task = HOSTILE.repeat(10_000);
    report.tags = (0..1000).map(|tag| (format!("{tag}{HOSTILE}"), HOSTILE.to_owned())).collect();
    let reasons = vec![HOSTILE.repeat(1000); 10_000];
    report.verdict = Judgement::Episode(Verdict { grade: Grade::Bad, reasons, sensors: None, replay_of: Vec::new() });
    report.modalities = (0..64).map(flapping).collect();
    report.mask = (0..10_000).map(|at| MaskEdge { at: f64::from(at) * 0.36, mask: HOSTILE.to_owned() }).collect();
    let noted = Notes {
        label: Some(Label::Failure),
        label_reason: HOSTILE.to_owned(),
        note: HOSTILE.repeat(1000),
        marks: Vec::new(),
    };
    for seconds in [3600.0, 0.0, 1e300, 4e-4] {
        report.seconds = seconds;
        let mut timeline = Timeline::new(Span::from_report(&report), false);
        timeline.rows = (0..64).filter_map(ModalityId::new).map(|id| (Subject::Modality(id), row())).collect();
        timeline.marks = (0..200).map(|at| Mark { share: f64::from(at) / 200.0, text: HOSTILE.to_owned() }).collect();
        let svg = draw::draw(&report, &timeline, Some(&noted));
        checked(&svg);
        assert!(!svg.contains("<script") && svg.len() < 12 << 20, "{seconds}: {} bytes", svg.len());
    }
}

#[test]
fn the_picture_of_a_small_episode_shows_when_a_device_was_there() {
    let Plot { report, svg } = plot_of(&testing::episode(testing::options())).unwrap();
    let document = checked(&svg);
    let words: Vec<_> = document.descendants().filter_map(|node| node.text()).collect();
    assert!(words.contains(&"x.mcap") && words.contains(&"mask"), "{words:?}");
    assert!(report.verdict.reasons().iter().all(|reason| words.contains(&format!("• {reason}").as_str())));
}

#[test]
fn a_file_of_another_program_shows_its_topics() {
    let mut bytes = Vec::new();
    let mut writer = mcap::Writer::new(std::io::Cursor::new(&mut bytes)).unwrap();
    for topic in 0..100_u16 {
        let channel =
            writer.add_channel(0, &format!("/other<{topic}>"), "json", &std::collections::BTreeMap::new()).unwrap();
        for sequence in 0..3 {
            let log_time = u64::from(sequence) * 1_000_000_000;
            let header =
                mcap::records::MessageHeader { channel_id: channel, sequence, log_time, publish_time: log_time };
            writer.write_to_known_channel(&header, b"{}").unwrap();
        }
    }
    writer.finish().unwrap();
    drop(writer);
    let svg = plot_of(&bytes).unwrap().svg;
    let document = checked(&svg);
    let names = document.descendants().filter(|node| node.attribute("class") == Some("name")).count();
    assert_eq!(names, 64);
    assert!(svg.contains("no verdict") && svg.contains("/other&lt;0&gt;"), "{svg}");
}

#[test]
fn no_bytes_cause_a_panic_or_a_picture_that_is_not_xml() {
    let config = ProptestConfig { cases: 64, ..ProptestConfig::default() };
    for bytes in testing::layouts().map(testing::episode) {
        proptest!(config.clone(), |(mutations in testing::mutations())| {
            if let Ok(plot) = plot_of(&testing::mutated(&bytes, &mutations)) {
                checked(&plot.svg);
            }
        });
    }
}
