//! The rows: the mask, then each modality with its rate, losses and pictures, or the topics of another program's file.

use std::collections::BTreeSet;
use std::fmt::Write;

use rapid_core::modality::ModalityId;
use rapid_core::text;

use super::{FIGURES, LEFT, MARGIN, PLOT, x};
use crate::plot::gather::{BINS, PICTURES, Row, Subject, Timeline};
use crate::plot::svg::{Anchor, Px, Svg};
use crate::record::inspect::{Inspection, ModalityReport};

/// Height of a row, and of that of the mask.
const BAND: f64 = 34.0;
const MASK: f64 = 18.0;
/// Where in a row a device is that sends at its nominal rate: above it is room for one that is too fast.
const NOMINAL: f64 = 0.82;
/// Space between pictures, and their greatest height.
const SPACE: f64 = 3.0;
const TALLEST: f64 = 84.0;
/// Samples that a step of the curve should stand for: fewer would be noise.
const SAMPLES: f64 = 10.0;
/// Steps that a curve has at least.
const STEPS: usize = 8;
/// Columns of a name.
const NAME: usize = 22;

/// Draws them from `y`; returns the lower edge.
pub(super) fn draw(page: &mut Svg, report: &Inspection, timeline: &Timeline, mut y: f64) -> f64 {
    if !report.mask.is_empty() {
        mask(page, report, timeline, y);
        y += MASK + 12.0;
    }
    let mut seen = BTreeSet::new();
    for modality in &report.modalities {
        // A modality may have two channels.
        if seen.insert(modality.bit)
            && let Some(id) = ModalityId::new(modality.bit)
        {
            let row = timeline.rows.get(&Subject::Modality(id));
            let band = Band::of_modality(modality, row, timeline);
            y = draw_row(page, &band, row, timeline, y);
        }
    }
    for (subject, row) in &timeline.rows {
        if matches!(subject, Subject::Topic(_)) {
            y = draw_row(page, &Band::of_topic(row, timeline), Some(row), timeline, y);
        }
    }
    y.max(BAND) - 12.0
}

/// The mask over time: every change, and its value where there is room.
fn mask(page: &mut Svg, report: &Inspection, timeline: &Timeline, y: f64) {
    page.text("name", MARGIN, y + 13.0, Anchor::Start, "mask");
    page.rect("track", [LEFT, y, PLOT, MASK], "");
    let share = |at: f64| (at / timeline.span.seconds).clamp(0.0, 1.0);
    let ends = report.mask.iter().skip(1).map(|edge| share(edge.at)).chain([1.0]);
    let (mut path, mut last) = (String::new(), f64::MIN);
    for (edge, end) in report.mask.iter().zip(ends) {
        let (begin, end) = (x(share(edge.at)), x(end));
        if end - begin > 12.0 + 7.0 * edge.mask.len() as f64 {
            page.text("code", f64::midpoint(begin, end), y + 13.0, Anchor::Middle, &edge.mask);
        }
        if begin > LEFT + 0.5 && begin - last >= 1.0 {
            last = begin;
            let _ = write!(path, "M{} {}v{}", Px(begin), Px(y), Px(MASK));
        }
    }
    page.path("edge", &path, "");
}

/// What a row shows beside its bins.
struct Band {
    name: String,
    about: String,
    /// When it was present, as shares; `None` if that is not known.
    present: Option<Vec<(f64, f64)>>,
    /// What it should send, or its mean rate, a second.
    hz: f64,
    has_nominal: bool,
    rate: String,
    lost: u64,
    class: &'static str,
    title: String,
}

impl Band {
    fn of_modality(modality: &ModalityReport, row: Option<&Row>, timeline: &Timeline) -> Self {
        let topic = &modality.topic;
        let nominal = modality.quality.as_ref().and_then(|quality| quality.nominal_hz).filter(|hz| *hz > 0.0);
        let presence = modality.presence.map_or(String::new(), |share| format!(", {} present", percent(share)));
        let of = nominal.map_or(String::new(), |nominal| format!(" of {}", (nominal * 10.0).round() / 10.0));
        let rate = if topic.messages > 1 { format!("{}{of} Hz", text::hertz(topic.hz)) } else { String::new() };
        let counted = modality.quality.as_ref().map(|quality| quality.lost.saturating_add(quality.dropped));
        let gap = topic.longest_gap * 1e3;
        let samples = text::counted(topic.messages, "sample");
        Self {
            name: modality.name.clone(),
            about: format!("bit {}{presence}", modality.bit),
            present: present(modality, row, timeline),
            hz: nominal.unwrap_or(topic.hz),
            has_nominal: nominal.is_some(),
            rate,
            lost: counted.unwrap_or(topic.missing),
            class: "rate",
            title: format!("{}: {samples}, longest time without one {gap:.0} ms", modality.name),
        }
    }

    fn of_topic(row: &Row, timeline: &Timeline) -> Self {
        let count: u64 = row.samples.iter().copied().map(u64::from).sum();
        let hz = count as f64 / timeline.span.seconds;
        Self {
            name: row.topic.clone(),
            about: String::new(),
            present: None,
            hz,
            has_nominal: false,
            rate: if count > 1 { format!("{} Hz", text::hertz(hz)) } else { String::new() },
            lost: row.missing.iter().copied().map(u64::from).sum(),
            class: "action",
            title: format!("{}: {}", row.topic, text::counted(count, "message")),
        }
    }
}

/// When a modality was present, as shares: by the mask, in a file without one by its frames.
fn present(modality: &ModalityReport, row: Option<&Row>, timeline: &Timeline) -> Option<Vec<(f64, f64)>> {
    if modality.presence.is_some() {
        let share = |at: f64| at / timeline.span.seconds;
        return Some(modality.present.iter().map(|(from, to)| (share(*from), share(*to))).collect());
    }
    let row = row.filter(|_| timeline.has_frames())?;
    let mut spans: Vec<std::ops::Range<usize>> = Vec::new();
    for (bin, (frames, present)) in timeline.frames.iter().zip(&row.present).enumerate() {
        match spans.last_mut() {
            // Between two frames it is as in the one before.
            Some(last) if last.end == bin && (*frames == 0 || *present > 0) => last.end = bin + 1,
            _ if *present > 0 => spans.push(bin..bin + 1),
            _ => {}
        }
    }
    let share = |bin: usize| bin as f64 / BINS as f64;
    Some(spans.into_iter().map(|span| (share(span.start), share(span.end))).collect())
}

fn draw_row(page: &mut Svg, band: &Band, row: Option<&Row>, timeline: &Timeline, y: f64) -> f64 {
    page.text("name", MARGIN, y + 14.0, Anchor::Start, &text::cut(&text::plain(&band.name), NAME, "…"));
    page.text("faint", MARGIN, y + 30.0, Anchor::Start, &band.about);
    page.text("", FIGURES, y + 14.0, Anchor::Start, &band.rate);
    if band.lost > 0 {
        page.text("loss", FIGURES, y + 30.0, Anchor::Start, &format!("{} lost", text::count(band.lost)));
    }
    page.rect("track", [LEFT, y, PLOT, BAND], &band.title);
    let spans = merged(band.present.as_deref().unwrap_or_default());
    let mut on = String::new();
    for (from, to) in &spans {
        let _ = write!(on, "M{} {}h{}v{}h-{}z", Px(*from), Px(y), Px(to - from), Px(BAND), Px(to - from));
    }
    page.path("on", &on, &band.title);
    if let Some(row) = row {
        curve(page, band, row, timeline, y);
        losses(page, row, y);
    }
    if band.has_nominal {
        let level = Px(y + BAND * (1.0 - NOMINAL));
        let mut nominal = String::new();
        for (from, to) in &spans {
            let _ = write!(nominal, "M{} {level}H{}", Px(*from), Px(*to));
        }
        page.path("nominal", &nominal, "");
    }
    page.path("edge", &edges(band.present.as_deref().unwrap_or_default(), y), "");
    if band.present.as_ref().is_some_and(Vec::is_empty) {
        page.text("faint", LEFT + PLOT / 2.0, y + BAND / 2.0 + 4.0, Anchor::Middle, "never present");
    }
    let strip = row.map_or(0.0, |row| pictures(page, &band.name, row, timeline, y + BAND + SPACE));
    y + BAND + strip + 12.0
}

/// Spans in pixels, with those merged that a screen cannot show apart.
fn merged(spans: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut merged: Vec<(f64, f64)> = Vec::new();
    for (from, to) in spans {
        let (from, to) = (x(*from), x(*to).max(x(*from) + 0.5));
        match merged.last_mut() {
            Some(last) if from - last.1 < 0.5 => last.1 = last.1.max(to),
            _ => merged.push((from, to)),
        }
    }
    merged
}

/// A line at each change of a bit, as far as a screen can show them apart.
fn edges(spans: &[(f64, f64)], y: f64) -> String {
    let (mut path, mut last) = (String::new(), f64::MIN);
    let inner = |share: &f64| (0.0005..0.9995).contains(share);
    for at in spans.iter().flat_map(|(from, to)| [*from, *to]).filter(inner).map(x) {
        if at - last >= 1.0 {
            last = at;
            let _ = write!(path, "M{} {}v{}", Px(at), Px(y - 2.0), Px(BAND + 4.0));
        }
    }
    path
}

/// The rate over time, in steps that stand for several samples each.
fn curve(page: &mut Svg, band: &Band, row: &Row, timeline: &Timeline, y: f64) {
    let bin = timeline.span.seconds / BINS as f64;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the number of bins")]
    let wide = (SAMPLES / (band.hz * bin)).ceil().clamp(1.0, (BINS / STEPS) as f64) as usize;
    let base = y + BAND;
    let mut path = String::new();
    // Where the figure that is being drawn has come to.
    let mut open: Option<f64> = None;
    for (step, bins) in row.samples.chunks(wide).enumerate() {
        let samples: u64 = bins.iter().copied().map(u64::from).sum();
        let (from, to) = ((step * wide) as f64 / BINS as f64, (step * wide + bins.len()) as f64 / BINS as f64);
        let whole = (to - from) * timeline.span.seconds;
        let (present, from, to) = overlap(band.present.as_deref(), from, to);
        // A few samples beside a presence are not a high rate.
        let time = (present * timeline.span.seconds).max(whole / 4.0);
        let share = samples as f64 / (band.hz * time);
        let height = (share * NOMINAL).clamp(0.0, 1.0) * BAND;
        let is_drawn = samples > 0 && height.is_finite();
        if open.is_some_and(|end| !is_drawn || x(from) - end > 0.5) {
            open = None;
            let _ = write!(path, "V{}z", Px(base));
        }
        if is_drawn {
            if open.is_none() {
                let _ = write!(path, "M{} {}", Px(x(from)), Px(base));
            }
            let _ = write!(path, "V{}H{}", Px(base - height), Px(x(to)));
            open = Some(x(to));
        }
    }
    if open.is_some() {
        let _ = write!(path, "V{}z", Px(base));
    }
    page.path(band.class, &path, &band.title);
}

/// How much of a step something was present, and where that begins and ends: in a step with an unplug, the rate is that
/// of the rest. A step without any presence counts as a whole.
fn overlap(present: Option<&[(f64, f64)]>, from: f64, to: f64) -> (f64, f64, f64) {
    let present = present.unwrap_or_default();
    // They follow each other: a recording that flaps has thousands, and only those of the step count.
    let first = present.partition_point(|(_, end)| *end <= from);
    let spans = present.iter().skip(first).take_while(|(begin, _)| *begin < to);
    let (sum, begin, end) = spans
        .map(|(begin, end)| (begin.max(from), end.min(to)))
        .filter(|(begin, end)| begin < end)
        .fold((0.0, to, from), |(sum, first, last), (begin, end)| (sum + end - begin, first.min(begin), last.max(end)));
    if sum > 0.0 { (sum, begin, end) } else { (to - from, from, to) }
}

/// Where samples are lost, hanging from above, as high as their share; and frames without one, along the lower edge.
fn losses(page: &mut Svg, row: &Row, y: f64) {
    let (mut lost, mut stale) = (String::new(), String::new());
    let wide = PLOT / BINS as f64;
    for (bin, (missing, samples)) in row.missing.iter().zip(&row.samples).enumerate() {
        if *missing > 0 {
            let share = f64::from(*missing) / (f64::from(*missing) + f64::from(*samples));
            let height = (share * BAND).max(6.0);
            let _ = write!(lost, "M{} {}h2.4v{}h-2.4z", Px(LEFT + bin as f64 * wide), Px(y), Px(height));
        }
    }
    let mut bin = 0;
    while bin < BINS {
        let run = row.stale.iter().skip(bin).take_while(|count| **count > 0).count();
        if run > 0 {
            let length = Px((run as f64 * wide).max(2.0));
            let _ = write!(stale, "M{} {}h{length}v4h-{length}z", Px(LEFT + bin as f64 * wide), Px(y + BAND - 4.0));
        }
        bin += run.max(1);
    }
    page.path("lost", &lost, "samples are lost");
    page.path("stale", &stale, "no sample lies in the window of a frame");
}

/// The pictures, each at its part of the time; returns their height.
fn pictures(page: &mut Svg, name: &str, row: &Row, timeline: &Timeline, y: f64) -> f64 {
    let Some(aspect) = row.pictures.iter().flatten().map(|picture| picture.aspect).next() else { return 0.0 };
    let wide = PLOT / PICTURES as f64;
    let height = ((wide - SPACE) / aspect).clamp(8.0, TALLEST);
    for (place, picture) in row.pictures.iter().enumerate() {
        let area = [LEFT + place as f64 * wide, y, wide - SPACE, height];
        match picture {
            Some(picture) => {
                let title = format!("{name} at {:.2} s", picture.share * timeline.span.seconds);
                page.jpeg(area, &picture.jpeg, &title);
            }
            None => page.rect("frame", area, &format!("no picture of {name} in this time")),
        }
    }
    height + SPACE
}

fn percent(share: f64) -> String {
    // Only what is whole is 100 %.
    if share >= 1.0 { "100 %".to_owned() } else { format!("{:.0} %", (share * 100.0).floor().abs()) }
}
