//! Policies: the inputs of a trained model, and the use of its answers.
//!
//! A policy is a folder, a [`bundle`]: two graphs and `policy.json`, with all the facts about
//! them that a rig needs. [`library`] brings onnxruntime into the process, [`graphs`] run on it.
//! [`picture`] and [`observation`] make what the encoder reads, [`sampler`] makes action chunks of
//! it: [`scheduler`] takes the noise out of a chunk step by step, [`normalize`] maps numbers into the
//! range a network was trained on and back. [`model`] is all that: requests in, chunks out.
//!
//! [`observer`] chooses what is seen at a tick and fills a [`request`], [`horizon`] decides which action
//! is executed at which tick, or that none is. [`pilot`] is these two: what a loop on the control grid
//! steps. [`live`] is that loop in real time.

pub mod bundle;
pub mod graphs;
pub mod horizon;
pub mod library;
pub mod live;
pub mod model;
pub mod normalize;
pub mod observation;
pub mod observer;
pub mod picture;
pub mod pilot;
pub mod request;
pub mod sampler;
pub mod scheduler;
