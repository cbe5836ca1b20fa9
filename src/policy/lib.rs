//! Policies: the inputs of a trained model, and the use of its answers.
//!
//! A policy is a folder, a [`bundle`]: two graphs and `policy.json`, with all the facts about them that a rig needs.
//! [`onnxruntime`] loads that library into the process, [`graphs`] run on it. [`picture`] and [`observation`] prepare the
//! encoder's input, [`sampler`] computes action chunks from its output: [`scheduler`] removes the noise from a chunk
//! step by step, [`normalize`] maps numbers into the range a network was trained on and back. [`model`] combines them:
//! requests in, chunks out.
//!
//! [`observer`] chooses the samples of a tick and fills a [`request`], [`compose`] makes absolute actions of a chunk,
//! [`horizon`] decides which action is executed at which tick, if any. [`pilot`] combines them and is stepped by a loop on the control grid. [`live`] is that loop in
//! real time.

pub mod bundle;
pub mod compose;
#[cfg(test)]
#[path = "../../tests/support/example.rs"]
mod example;
pub mod graphs;
pub mod horizon;
pub mod live;
pub mod model;
pub mod normalize;
pub mod observation;
pub mod observer;
pub mod onnxruntime;
pub mod pace;
pub mod picture;
pub mod pilot;
pub mod request;
pub mod sampler;
pub mod scheduler;

#[cfg(test)]
extern crate self as rapid_policy;
