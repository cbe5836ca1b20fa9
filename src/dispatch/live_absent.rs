//! The Foxglove server of a program that was built without cargo feature `foxglove`: it is refused, with the fix.

use super::Failure;
use crate::app::LiveOptions;
use crate::cli::LiveArgs;

const NOT_BUILT: &str = "this rapid was built without `foxglove`: build it with `cargo build --release --features foxglove`, or leave \
     --foxglove out";

pub(super) fn options_of(args: LiveArgs) -> Result<Option<LiveOptions>, Failure> {
    if args.foxglove.is_some() { Err(Failure::argument(NOT_BUILT)) } else { Ok(None) }
}
