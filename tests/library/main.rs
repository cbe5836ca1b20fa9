//! The library by its public items, in the process of the tests.
//!
//! The global allocator counts the allocations of each thread, so the tests may run side by side. What a whole process
//! allocates is counted in `tests/memory`.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "what fails here fails a test")]

/// What several test executables share.
#[path = "../support"]
mod support {
    pub(crate) mod allocations;
    pub(crate) mod arm;
    pub(crate) mod given;
    pub(crate) mod mistakes;
    pub(crate) mod motor_world;
    pub(crate) mod motors;
    pub(crate) mod onnx;
    pub(crate) use motors::patience;
}

mod bundle;
mod control_alloc;
mod driver_contract;
mod motor_faults;
mod motors;
mod policy;
mod policy_alloc;
mod poses;
mod record_alloc;
mod registry;
mod schemas;
