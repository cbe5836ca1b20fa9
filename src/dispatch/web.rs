//! The page of a run.

use super::Failure;
use crate::app::WebOptions;
use crate::cli::WebArgs;

/// The page of a run, if one was requested.
#[expect(clippy::unnecessary_wraps, reason = "it fails without the feature")]
pub(super) fn options_of(args: &WebArgs) -> Result<Option<WebOptions>, Failure> {
    Ok(args.web.map(|address| WebOptions { address, token: args.web_token.clone() }))
}
