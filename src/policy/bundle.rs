//! A policy bundle: the folder `models/<name>/` with `policy.json` and the two graphs it names.
//!
//! `encoder.onnx` takes one input per observation, named by its key (image f32 `[B, To, 3, H, W]`,
//! vector f32 `[B, To, D]`), and the mask (f32 `[B, M]`), and gives `global_cond` (f32 `[B, Dc]`).
//! `denoiser.onnx` takes `sample` (f32 `[B, Tp, Da]`), `timestep` (i64 `[B]`) and `global_cond`, and
//! gives its prediction (f32 `[B, Tp, Da]`). `B` is 1 or left open. `To` is `n_obs_steps`, `Tp` is
//! `horizon`, `Da` the number of values of an action, `M` the length of the mask's order.
//!
//! Text -> `read` (values with the names of their keys) -> `parse` -> [`Bundle`]. What the file says
//! is then held against the registry ([`Bundle::check_registry`]) and against what the graphs say of
//! themselves ([`Bundle::check_graphs`]).
//!
//! Invariant: of every check all mistakes are told at once, each with the key and a fix.
//! Invariant: nothing downstream of a [`Bundle`] checks it again.

mod action;
mod devices;
#[cfg(test)]
pub(crate) mod example;
mod external;
mod files;
mod graphs;
mod inside;
mod json;
mod keys;
mod observations;
mod parse;
mod read;
mod spec;
#[cfg(test)]
mod tests;

pub use files::{Graph, POLICY_FILE};
pub use graphs::{Element, GraphShape, TensorShape};
pub use spec::{
    BetaSchedule, Bundle, BundleAction, BundleErrors, ColorOrder, GraphFile, ImageSpec, MaskSpec, Normalization,
    ObservationInput, ObservationSpec, Operation, PredictionType, SchedulerKind, SchedulerSpec, SliceNormalization,
    TimestepSpacing, VectorSpec,
};
