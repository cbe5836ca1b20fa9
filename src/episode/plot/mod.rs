//! A picture of an episode, as SVG: its verdict, and for each modality presence, rate, losses and pictures over time.
//!
//! The report of `record::inspect` has the figures; the file is read once more for what the report leaves out, in bins
//! of time. `gather` reads, `thumbnail` makes small pictures, `draw` draws, `svg` writes.
//!
//! Invariant: memory and the size of the picture are bounded, whatever the length of the episode.
//! Invariant: the picture refers to nothing outside of it and contains no script; every text in it is escaped.

mod draw;
mod gather;
mod svg;
#[cfg(test)]
mod tests;
mod thumbnail;

use std::path::Path;

use rapid_status::session::Notes;

use crate::reader::Reader;
use crate::record::inspect::{self, Inspection, Judgement, ReadError};
use gather::{Span, Timeline};

/// How every picture begins, by which it is recognised as made here.
pub const BEGINNING: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<!-- An episode, drawn by rapid. -->\n";

/// A picture, and the report it is made of.
#[derive(Debug)]
pub struct Plot {
    /// What the file holds.
    pub report: Inspection,
    /// The picture.
    pub svg: String,
}

/// Draws the episode at `path`, finished or not, with what people noted about it.
///
/// # Errors
/// When it cannot be read or is not an MCAP file. An unfinished or damaged one is not an error.
pub fn plot(path: &Path, noted: Option<&Notes>) -> Result<Plot, ReadError> {
    let report = inspect::inspect(path)?;
    // A file of another program has no modalities: then its topics are drawn.
    let every_topic = report.modalities.is_empty() && report.verdict == Judgement::NotOurs;
    let mut timeline = Timeline::new(Span::from_report(&report), every_topic);
    match Reader::open(path) {
        Ok(mut reader) => {
            while reader.advance()? {
                timeline.add(&reader.item());
            }
        }
        // The recorder's mark that it failed is all there is.
        Err(ReadError::NotMcap(_)) => {}
        Err(error) => return Err(error),
    }
    let svg = draw::draw(&report, &timeline, noted);
    Ok(Plot { report, svg })
}
