//! Policies: what a trained model wants to see, and what becomes of its answers.
//!
//! A policy is a folder, a [`bundle`]: two graphs and `policy.json`, which says everything about
//! them that a rig must know. [`library`] opens onnxruntime, [`graphs`] runs the two. [`picture`] and
//! [`normalize`] make numbers of samples, [`scheduler`] takes the noise out of an action chunk step by
//! step, [`horizon`] decides which action is executed at which tick, or that none is. [`observer`] chooses
//! what is seen at a tick; [`pilot`] is the two together.

pub mod bundle;
pub mod graphs;
pub mod horizon;
pub mod library;
pub mod normalize;
pub mod observer;
pub mod picture;
pub mod pilot;
pub mod request;
pub mod scheduler;
