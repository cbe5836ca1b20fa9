//! Small commands that only print.

pub mod completions;
pub mod mask;
