//! Episodes as a LeRobot v3.0 dataset: Parquet tables, one row for each tick of the frame index.
//!
//! `rows` reads an episode tick by tick, `survey` finds out what it holds and whether it can be exported, `features` is
//! what all episodes of a dataset have in common, `cells` the values of one row, `table` and `set` the files, `video` and
//! `ffmpeg` the videos, and `verify` compares all of it with the episodes again.
//!
//! The format is that of `lerobot` 0.4.4, `CODEBASE_VERSION` v3.0:
//! <https://huggingface.co/docs/lerobot/lerobot-dataset-v3>.
//!
//! Invariant: which sample belongs to a row follows from `/rapid/frame` alone.
//! Invariant: an episode is in the set once its file in `meta/episodes` has its name, and everything of it is complete
//! by then; a program that is killed leaves files without a name in the set, and the next one removes them.
//! Invariant: an episode's rows depend on nothing but the episode, the features and its position in the set, so that it makes
//! no difference how many are prepared at a time.

mod cells;
mod error;
#[cfg(test)]
#[path = "../../tests/support/executable.rs"]
mod executable;
mod features;
mod ffmpeg;
mod files;
mod owned;
mod picture;
mod rows;
mod set;
mod statistics;
mod survey;
mod table;
#[cfg(test)]
mod tests;
mod verify;
mod video;

pub use error::SetError;
pub use features::{Features, Known, NotExported};
pub use ffmpeg::{Ffmpeg, FfmpegError};
pub use picture::{Codec, Pictures};
pub use rows::{Refusal, Unfit};
pub use set::{DataSet, Prepared, prepare};
pub use survey::{Survey, Verdicts, survey};
pub use table::Position;
pub use verify::{Difference, Verified, verify};
pub use video::{Encoded, Ends, encode};
