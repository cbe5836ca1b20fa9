//! `rapid`: hot-plug discovery, Physical Mask, streaming, synchronisation and recording for
//! robot-learning rigs, in one binary.
//!
//! # The picture
//!
//! ```text
//!  L5   main   dispatch   cli   commands         the command line
//!  L4   app                                      connects the stages, and is the only one to know all of them
//!       tui   headless   logging                 what is displayed: Snapshots and Events of `status`
//!       lockstep   compare                       a rig on a virtual clock; a policy compared with a recording
//!
//!  L3   rig                                      owns the life cycle of every device, and the mask
//!        |  slot: state  stream: its data        presence: publish the mask
//!        |                        |
//!  L2   hotplug      driver ----> | ----> bus -------.          .---- sync
//!       plugged,     bytes in             topics in  |          |     which sample belongs
//!       unplugged                         shared     |          |     to which tick
//!                                         memory     v          v
//!  L3                                                record      one episode, one MCAP file
//!                                                    policy      observations to actions, on the robot
//!
//!  L2   episode                                    an episode's file: schema, encoder, reader, index, repair
//!       calibration                                latency of a sensor
//!       orders                                     orders of other programs to arm and disarm motors
//!       interlocks                                 inputs of emergency stops and enabling switches
//!
//!  L1   registry                                 devices.toml, checked
//!       status                                   the board that every stage reports to
//!       text   outlet                            formatting and output of text
//!       folder                                   symlink-safe file access
//!       control                                  motor control: limits, interpolation, arming
//!       realtime                                 threads with a fixed period
//!       panics                                   destination of panic messages
//!       peer                                     identity of the peer of a socket
//!  L0   modality   mask   sample   action   interlock   permission   time   random   provenance   flash   nouns
//! ```
//!
//! The arrows show the flow of data. Imports point down only; the stages of L3 do not depend on one
//! another, nor do the mechanisms of L2. Every third-party crate is used by one module.
//! `tests/layering.rs` holds all this as a table and checks it.
//!
//! A modality is what a policy would call one observation: a camera, the state of a motor. It has
//! one number, [`modality::ModalityId`], which is its bit in the mask, its event on the bus, its index
//! in every array and its row on screen.
//!
//! # One frame
//!
//! 1. A camera fills a buffer of the kernel; the descriptor becomes readable and wakes the device's
//!    task. [`driver`] lends the buffer as a [`driver::Reading`], with the kernel's capture time.
//! 2. `rig::stream` adds a [`sample::SampleHeader`] and passes both to the topic's [`bus::Writer`]:
//!    one copy, into shared memory, as the device delivered it. Then it wakes the waiting readers; the
//!    number of the event identifies the modality.
//! 3. The `writer` thread of [`record`] takes it from its [`bus::Inbox`] and writes it to the episode
//!    straight from shared memory, stamped with its capture time.
//! 4. Once per tick of the observation grid, [`sync`] chooses for each modality the sample nearest to
//!    the tick, and the recorder writes the choice, with the mask, to the same file.
//!
//! Other programs subscribe to the same topics in the same way.
//!
//! # One action
//!
//! 1. At each tick of the control grid, thread `grid` of [`policy::live`] takes new samples from the bus, and
//!    [`policy::observer`] chooses the observations, with [`sync`]'s rules.
//! 2. When a chunk is due, or a bit of the mask has changed, the samples go to thread `policy`, which converts
//!    them to tensors and runs the encoder once and the denoiser step by step.
//! 3. [`policy::horizon`] determines the action and chunk for the tick, or that there is none. The action is
//!    published on the topic of actions.
//! 4. The stream of the actuator passes it to its driver; the recorder writes it.
//!
//! # One unplug
//!
//! 1. Three sources report a pulled cable: the stream's read error, the kernel's uevent, udev's
//!    event. They arrive in any order, tens of milliseconds apart.
//! 2. The first to reach the [`rig`] moves the slot of the device ([`rig::slot`], a pure state
//!    machine) to `Absent`. Later reports carry an older [`sample::Epoch`], or repeat what is
//!    known, and change nothing.
//! 3. The bit is cleared and published at once, without waiting for the device or its task.
//! 4. The topic stays: its recorder and every other subscriber continue and see a gap. A tick without
//!    the device has its bit 0.
//! 5. When a device of that identity returns, the slot waits for the cooldown and opens it in a new
//!    epoch; with its first sample the bit is set again.
//!
//! # Invariants
//!
//! * A bit is set exactly while its device is attached and has sent a sample in this epoch. Late data
//!   does not clear it; the slot is then `Stalled`.
//! * Only [`rig`] decides the mask, and none of its work may delay the publication. [`lockstep`] applies the
//!   same slots on its virtual clock.
//! * Motors move only after an arm, and are turned off on every exit path. No arm is given while an emergency stop or
//!   an enabling switch does not report that it runs, and what it stops stays stopped until a newer arm.
//! * A writer never waits for a reader: a slow reader loses the oldest samples, and sees a gap in `seq`.
//!   What is lost is counted and reported.
//! * Nothing downstream is reconnected on plug and unplug: topics live as long as the run.
//! * A simulated device is a device: it enters as a hot-plug event and is opened as a driver, and
//!   no other code can distinguish it.
//! * Between two samples a stream does not allocate, nor does iceoryx2 for it; it neither locks nor
//!   logs.
//! * Capture times are `CLOCK_MONOTONIC`; the wall clock is derived from it once per episode.
//! * A screen sees [`status::Snapshot`]s and sends [`status::Command`]s; it holds no handle into a
//!   stage.
//! * Bytes from devices and files never make the program panic. `unsafe` occurs only in [`driver`],
//!   [`bus`], [`peer`] and the loader of onnxruntime.

// The whole program is linted with all features; with fewer, code that only they use is unused.
#![cfg_attr(
    not(all(feature = "lan", feature = "motors", feature = "policy")),
    allow(dead_code, unused_imports, unused_variables, clippy::match_same_arms, clippy::needless_pass_by_value)
)]

pub mod action;
pub mod app;
pub mod bell;
pub mod bus;
pub mod calibration;
pub mod cli;
pub mod commands;
#[cfg(feature = "policy")]
pub mod compare;
#[cfg(feature = "motors")]
pub mod control;
pub mod disk;
pub mod dispatch;
pub mod driver;
pub mod episode;
pub mod fault;
pub mod flash;
pub mod folder;
pub mod gpio;
pub mod headless;
pub mod hotplug;
pub mod interlock;
pub mod interlocks;
#[cfg(feature = "policy")]
pub mod lockstep;
pub mod logging;
pub mod mask;
pub mod modality;
pub mod orders;
pub mod outlet;
pub mod panics;
pub mod peer;
pub mod permission;
#[cfg(feature = "policy")]
pub mod policy;
pub mod provenance;
pub mod random;
pub mod realtime;
pub mod record;
pub mod registry;
pub mod rig;
pub mod sample;
pub mod status;
pub mod sync;
pub mod text;
pub mod time;
pub mod tui;
