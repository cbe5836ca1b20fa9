//! The Foxglove server of a run.

use super::Failure;
use crate::app::LiveOptions;
use crate::cli::LiveArgs;

/// The server of a run, if one was requested.
#[expect(clippy::unnecessary_wraps, reason = "it fails without the feature")]
pub(super) fn options_of(args: LiveArgs) -> Result<Option<LiveOptions>, Failure> {
    Ok(args.foxglove.map(|address| LiveOptions { address, control: args.foxglove_control }))
}
