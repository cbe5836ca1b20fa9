//! Where everything of the picture lies, and what it looks like.

mod head;
mod rows;

use std::fmt::Write;

use rapid_core::text;
use rapid_status::session::Notes;

use super::gather::Timeline;
use super::svg::{Anchor, Px, Svg};
use crate::record::inspect::Inspection;

/// Width of the picture, and the margin around what it shows.
const WIDTH: f64 = 1180.0;
const MARGIN: f64 = 28.0;
/// Where the time begins, and how wide all of it is; the figures of a row are to its right.
const LEFT: f64 = 204.0;
const PLOT: f64 = 816.0;
const FIGURES: f64 = LEFT + PLOT + 14.0;
/// Most lines across the time.
const TICKS: f64 = 10.0;
/// Columns of the text of a mark, and how far apart marks with text lie at least.
const MARK: usize = 22;
const MARK_WIDTH: f64 = 150.0;

const STYLE: &str = "\
text{font-family:system-ui,-apple-system,'Segoe UI',Roboto,'DejaVu Sans',sans-serif;font-size:12px;fill:#1f2328}
.paper{fill:#fff;stroke:#d0d7de}
.title{font-size:20px;font-weight:600}.name{font-size:13px;font-weight:600}.faint{fill:#59636e}
.code{font-family:ui-monospace,'DejaVu Sans Mono',monospace;font-size:11px;fill:#59636e}
.word{font-size:13px;font-weight:700;fill:#fff}
.GOOD{fill:#1a7f37}.SUSPECT{fill:#9a6700}.BAD,.loss{fill:#cf222e}.none{fill:#59636e}
.track{fill:#eef1f4}.on{fill:#e2f4e7}.rate{fill:#71c28a}.action{fill:#8fb1ee}
.nominal{stroke:#116329;stroke-dasharray:2 3;fill:none}.lost{fill:#cf222e}.stale{fill:#e0a100}
.edge{stroke:#1f2328;stroke-width:1.4;fill:none}.grid{stroke:#d8dee4;fill:none}
.mark{stroke:#8250df;stroke-width:1.4;stroke-dasharray:5 3;fill:none}.caption{fill:#8250df;font-size:11.5px;font-weight:600}
.void{fill:url(#void)}.frame{fill:none;stroke:#d0d7de}
";

/// The picture of a report, a timeline and what people noted.
pub(super) fn draw(report: &Inspection, timeline: &Timeline, noted: Option<&Notes>) -> String {
    let mut page = Svg::default();
    let mut y = head::draw(&mut page, report, noted);
    let marks = marks_height(timeline);
    let top = y + marks;
    let mut rows = Svg::default();
    y = rows::draw(&mut rows, report, timeline, top);
    grid(&mut page, timeline.span.seconds, top, y);
    page.raw(format_args!("{}", rows.finish()));
    silences(&mut page, timeline, top, y);
    draw_marks(&mut page, timeline, top, y);
    y = legend(&mut page, report, timeline, y + 40.0);
    whole(&page.finish(), y + MARGIN)
}

fn whole(page: &str, height: f64) -> String {
    let (width, height) = (Px(WIDTH), Px(height));
    let mut text = super::BEGINNING.to_owned();
    // Writing to a string cannot fail.
    let _ = write!(
        text,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\">\n\
         <style>\n{STYLE}</style>\n\
         <defs><pattern id=\"void\" width=\"8\" height=\"8\" patternUnits=\"userSpaceOnUse\" patternTransform=\"rotate(45)\">\
         <rect width=\"8\" height=\"8\" fill=\"#fff\" fill-opacity=\"0.7\"/><rect width=\"3\" height=\"8\" fill=\"#cf222e\" \
         fill-opacity=\"0.45\"/></pattern></defs>\n\
         <rect class=\"paper\" x=\"0.5\" y=\"0.5\" width=\"{}\" height=\"{}\" rx=\"8\"/>\n{page}</svg>\n",
        Px(width.0 - 1.0),
        Px(height.0 - 1.0)
    );
    text
}

/// Where a share of the time lies.
fn x(share: f64) -> f64 {
    LEFT + share.clamp(0.0, 1.0) * PLOT
}

/// Lines across all rows at round times, and the times below.
fn grid(page: &mut Svg, seconds: f64, top: f64, bottom: f64) {
    let step = step(seconds);
    let mut at = 0.0;
    let mut path = String::new();
    while at <= seconds * 1.0001 {
        let place = x(at / seconds);
        let _ = write!(path, "M{} {}V{}", Px(place), Px(top), Px(bottom + 5.0));
        page.text("faint", place, bottom + 19.0, Anchor::Middle, &time(at, step, seconds));
        at += step;
    }
    page.path("grid", &path, "");
}

/// The time between two lines: 1, 2 or 5 times a power of ten, or a part of an hour.
fn step(seconds: f64) -> f64 {
    const MINUTES: [f64; 9] = [15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0, 3600.0];
    let decades = (-4..=0).flat_map(|power| [1.0, 2.0, 5.0].map(|digit| digit * 10_f64.powi(power)));
    let steps = decades.chain([10.0]).chain(MINUTES);
    let fits = |step: &f64| seconds / step <= TICKS;
    steps.clone().find(fits).unwrap_or_else(|| {
        let mut step = 7200.0;
        while !fits(&step) {
            step *= 2.0;
        }
        step
    })
}

fn time(at: f64, step: f64, seconds: f64) -> String {
    if seconds >= 120.0 {
        let exact = std::time::Duration::try_from_secs_f64(at);
        return exact.map_or_else(|_| format!("{at:.1e} s"), text::clock);
    }
    let digits = if step >= 1.0 {
        0
    } else if step >= 0.1 {
        1
    } else {
        4
    };
    format!("{at:.digits$} s")
}

/// Times of which the file has nothing.
fn silences(page: &mut Svg, timeline: &Timeline, top: f64, bottom: f64) {
    for (from, to) in timeline.silences() {
        let seconds = timeline.span.seconds;
        let title = format!("nothing from {:.2} to {:.2} s is in the file", from * seconds, to * seconds);
        page.rect("void", [x(from), top, (x(to) - x(from)).max(2.0), bottom - top], &title);
    }
}

/// The marks that have room for their text: the level of each, 0 or 1 from below.
fn levels(timeline: &Timeline) -> Vec<Option<u8>> {
    let mut free = [f64::MIN; 2];
    let level = |mark: &super::gather::Mark| {
        let at = x(mark.share);
        let level = free.iter().position(|free| *free <= at)?;
        *free.get_mut(level)? = at + MARK_WIDTH;
        u8::try_from(level).ok()
    };
    timeline.marks.iter().map(level).collect()
}

fn marks_height(timeline: &Timeline) -> f64 {
    match levels(timeline).iter().flatten().max() {
        None => 0.0,
        Some(level) => 18.0 * (f64::from(*level) + 1.0),
    }
}

fn draw_marks(page: &mut Svg, timeline: &Timeline, top: f64, bottom: f64) {
    for (mark, level) in timeline.marks.iter().zip(levels(timeline)) {
        let at = x(mark.share);
        let height = level.map_or(0.0, |level| 18.0 * f64::from(level) + 14.0);
        let seconds = mark.share * timeline.span.seconds;
        let title = format!("marked at {seconds:.2} s {}", mark.text);
        page.path("mark", &format!("M{} {}V{}", Px(at), Px(top - height), Px(bottom)), title.trim_end());
        if level.is_some() {
            let text = if mark.text.is_empty() { "mark" } else { &mark.text };
            let text = text::cut(text, MARK, "…");
            let (place, anchor) =
                if at + MARK_WIDTH > WIDTH { (at - 4.0, Anchor::End) } else { (at + 4.0, Anchor::Start) };
            page.text("caption", place, top - height + 9.0, anchor, &text);
        }
    }
}

/// What the colours mean, as far as they occur; returns its lower edge.
fn legend(page: &mut Svg, report: &Inspection, timeline: &Timeline, y: f64) -> f64 {
    let occurs = |bins: fn(&super::gather::Row) -> &Vec<u32>| {
        timeline.rows.values().any(|row| bins(row).iter().any(|count| *count > 0))
    };
    let has_edges = report.modalities.iter().any(|modality| modality.presence.is_some());
    let entries = [
        (has_edges || timeline.has_frames(), "on", "present (its bit of the mask)"),
        (true, "rate", "rate, dotted line: nominal"),
        (occurs(|row| &row.missing), "lost", "samples lost"),
        (occurs(|row| &row.stale), "stale", "no sample in the window of a frame"),
        (!timeline.silences().is_empty(), "void", "nothing in the file"),
    ];
    let mut at = LEFT;
    for (_, class, words) in entries.into_iter().filter(|(occurs, ..)| *occurs) {
        page.rect(class, [at, y - 9.0, 14.0, 10.0], "");
        page.text("faint", at + 20.0, y, Anchor::Start, words);
        at += 42.0 + 6.4 * text::width(words) as f64;
    }
    y
}
