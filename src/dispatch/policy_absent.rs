//! Policies of a program that was built without cargo feature `policy`: each request is rejected with the fix.

use rapid_registry::Registry;

use super::Failure;
use crate::app::PolicyOptions;
use crate::cli::{Global, PolicyArgs, ReplayArgs, RunArgs, TaskArgs};
use crate::commands::Format;

const NOT_BUILT: &str = "this rapid was built without `policy`: build it with `cargo build --release --features policy`, or leave --infer \
     and --expert out";

pub(super) fn policy_of(args: PolicyArgs, _: u64, _: &Registry) -> Result<Option<PolicyOptions>, Failure> {
    if args.infer.is_some() { Err(Failure::argument(NOT_BUILT)) } else { Ok(None) }
}

pub(super) fn compare(_: ReplayArgs, _: Format) -> Result<(), Failure> {
    Err(Failure::argument(NOT_BUILT))
}

pub(super) fn demonstrate(_: &Global, _: &RunArgs, _: &TaskArgs, _: Format) -> Result<(), Failure> {
    Err(Failure::argument(NOT_BUILT))
}
