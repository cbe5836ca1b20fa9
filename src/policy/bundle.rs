//! A policy bundle: the folder `models/<name>/` with `policy.json` and the two graphs it names.
//!
//! `encoder.onnx` takes one input per observation, named by its key (image f32 `[B, To, 3, H, W]`, vector f32
//! `[B, To, D]`), and the mask (f32 `[B, M]`); for an observation with a history of `S` steps the picture is
//! `[B, S, 3, H, W]`, and a further input says which of them have a sample (f32 `[B, S]`). It returns `global_cond` (f32
//! `[B, Dc]`). `denoiser.onnx` takes `sample` (f32 `[B, Tp, Da]`), `timestep` (i64 `[B]`) and `global_cond`, and returns
//! its prediction (f32 `[B, Tp, Da]`). `B` is 1 or left open. `To` is `n_obs_steps`, `Tp` is `horizon`, `Da` the length of
//! an action in this output, `M` that of the mask's order.
//!
//! Text -> `read` (no key twice, serde, types of `file` and `spec`) -> `validate` -> [`Bundle`]. It
//! is then compared with the registry ([`Bundle::check_registry`]) and with the inputs and outputs of the graphs
//! ([`Bundle::check_graphs`]).
//!
//! Invariant: every check reports all errors at once, each with the path of its key and a fix.
//! Invariant: no later code checks a [`Bundle`] again.

mod action;
mod external;
mod file;
mod files;
mod normalization;
mod read;
mod spec;
mod suits;
#[cfg(test)]
mod tests;
mod validate;
mod values;

pub use files::{Graph, POLICY_FILE};
pub use spec::{
    ActionRotation, BasePose, BetaSchedule, Bundle, BundleAction, BundleErrors, ColorOrder, GraphFile, HistorySpec,
    ImageSpec, MaskSpec, Normalization, ObservationInput, ObservationSpec, Operation, PredictionType, Representation,
    SchedulerKind, SchedulerSpec, SliceNormalization, TimestepSpacing, VectorOperation, VectorRotation, VectorSpec,
    WhenAbsent,
};
pub(super) use spec::{POSITION, QUATERNION};
pub use suits::{Element, GraphShape, TensorShape};
