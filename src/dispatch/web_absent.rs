//! The page of a program that was built without cargo feature `web`: it is refused, with the fix.

use super::Failure;
use crate::app::WebOptions;
use crate::cli::WebArgs;

const NOT_BUILT: &str =
    "this rapid was built without `web`: build it with `cargo build --release --features web`, or leave --web out";

pub(super) fn options_of(args: &WebArgs) -> Result<Option<WebOptions>, Failure> {
    if args.web.is_some() { Err(Failure::argument(NOT_BUILT)) } else { Ok(None) }
}
