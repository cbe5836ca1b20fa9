//! Policies: what a trained model wants to see, and what becomes of its answers.
//!
//! A policy is a folder, a [`bundle`]: two graphs and `policy.json`, which says everything about
//! them that a rig must know. [`scheduler`] takes the noise out of an action chunk step by step,
//! [`normalize`] maps numbers into the range a network was trained on and back, [`horizon`] decides
//! which action is executed at which tick, or that none is.

pub mod bundle;
pub mod graphs;
pub mod library;
pub mod picture;
