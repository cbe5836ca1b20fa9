//! `rapid`: hot-plug discovery, Physical Mask, streaming, synchronisation and recording for
//! robot-learning rigs, in one binary.
//!
//! # The picture
//!
//! ```text
//!  L5   main   dispatch   cli   commands         what was typed
//!  L4   app                                      puts the stages together, and alone knows them all
//!       tui   headless   logging                 what is shown: Snapshots and Events of `status`
//!       lockstep   compare                       a rig on a virtual clock; a policy beside a recording
//!
//!  L3   rig                                      owns every device's life, and the mask
//!        |  slot: may it run?  stream: run it    presence: publish the mask
//!        |                        |
//!  L2   hotplug      driver ----> | ----> bus -------.          .---- sync
//!       plugged,     bytes in             topics in  |          |     which sample belongs
//!       pulled out                        shared     |          |     to which tick
//!                                         memory     v          v
//!  L3                                                record      one episode, one MCAP file
//!                                                    policy      observations to actions, on the robot
//!
//!  L2   episode                                    an episode's file: schema, encoder, reader, index, repair
//!       calibration                                how late a sensor is
//!       orders                                     may motors move? what other programs say
//!       interlocks                                 and what emergency stops and enabling switches say
//!
//!  L1   registry                                 devices.toml, checked
//!       status                                   the board every stage reports on
//!       text   outlet                            words and lines for people
//!       folder                                   symlink-safe file access
//!       control                                  motor control: limits, interpolation, arming
//!       realtime                                 threads that keep a beat
//!       panics                                   where their messages go
//!       peer                                     who is at the other end of a socket
//!  L0   modality   mask   sample   action   interlock   permission   time   random   provenance   flash   nouns
//! ```
//!
//! The arrows are the way of the data. Imports point down only; the stages of L3 do not know one
//! another, nor do the mechanisms of L2. Every third-party crate has one home. `tests/layering.rs`
//! holds all this as a table and checks it.
//!
//! A modality is what a policy would call one observation: a camera, the state of a motor. It has
//! one number, [`modality::ModalityId`], which is its bit in the mask, its event on the bus, its index
//! in every array and its row on screen.
//!
//! # One frame
//!
//! 1. A camera fills a buffer of the kernel; the descriptor becomes readable and wakes the device's
//!    task. [`driver`] lends the buffer as a [`driver::Reading`], with the kernel's capture time.
//! 2. `rig::stream` puts a [`sample::SampleHeader`] beside it and hands both to the topic's
//!    [`bus::Writer`]: one copy, into shared memory, as the device gave it. Then it wakes whoever
//!    waits; the event's number says which modality.
//! 3. The `writer` thread of [`record`] takes it from its [`bus::Inbox`] and writes it to the episode
//!    straight from shared memory, stamped with its capture time.
//! 4. Once per tick of the observation grid, [`sync`] chooses of each modality the sample nearest to
//!    the tick, and the recorder writes which ones those were, with the mask, beside the samples.
//!
//! Other programs subscribe to the same topics on the same terms.
//!
//! # One action
//!
//! 1. At each tick of the control grid, thread `grid` of [`policy::live`] takes what the bus brought, and
//!    [`policy::observer`] chooses what is seen, with [`sync`]'s rules.
//! 2. When a chunk is due, or a bit of the mask has changed, the samples go to thread `policy`, which makes
//!    tensors of them and runs the encoder once and the denoiser step by step.
//! 3. [`policy::horizon`] says which action of which chunk is that of the tick, or that there is none. It is
//!    published on the topic of actions.
//! 4. The stream of the actuator hands it to its driver; the recorder writes it.
//!
//! # One unplug
//!
//! 1. Three witnesses tell of a pulled cable: the stream's own error, the kernel's uevent, udev's
//!    event. They come in any order, tens of milliseconds apart.
//! 2. The first to reach the [`rig`] moves the slot of the device ([`rig::slot`], a pure state
//!    machine) to `Absent`. Later reports carry an older [`sample::Epoch`], or repeat what is
//!    known, and changes nothing.
//! 3. The bit is cleared and published at once, without waiting for the device or its task.
//! 4. The topic stays: its recorder and every other subscriber continue and see a gap. A tick without
//!    the device has its bit 0.
//! 5. When a device of that identity comes back, the slot waits out the cooldown and opens it in a new
//!    epoch; with its first sample the bit is set again.
//!
//! # Invariants
//!
//! * A bit is set exactly while its device is attached and has sent a sample in this epoch. Late data
//!   does not clear it; the slot says `Stalled`.
//! * Only [`rig`] decides the mask, and nothing it does may hold up its publication. [`lockstep`] applies the
//!   same slots on its virtual clock.
//! * Motors move only after an arm, and are turned off on every way out. Nothing is armed while an emergency stop or an
//!   enabling switch does not say that it runs, and what it stops is stopped until a newer arm.
//! * A writer never waits for a reader: who falls behind loses the oldest, and sees a hole in `seq`.
//!   What is lost is counted and reported.
//! * Nothing downstream is re-wired on plug and unplug: topics live as long as the run.
//! * A simulated device is a device: it enters as a hot-plug event and is opened as a driver, and
//!   nothing beyond can tell.
//! * Between two samples a stream allocates nothing, nor does iceoryx2 for it; it locks nothing and
//!   logs nothing of its own.
//! * Capture times are `CLOCK_MONOTONIC`; the wall clock is derived from it once an episode.
//! * A screen sees [`status::Snapshot`]s and sends [`status::Command`]s; it holds no handle into a
//!   stage.
//! * Bytes from devices and files never make the program panic. `unsafe` stands in [`driver`],
//!   [`bus`], [`peer`] and the loader of onnxruntime alone.

// The whole program is linted with all features; with fewer, what only they use is left over.
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
