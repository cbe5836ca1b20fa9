//! Measurements in separate processes, so that the kernel accounts for each in the same way.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::Subcommand;
use mcap::WriteOptions;
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use rapid_core::time::Stamp;
use rapid_devices::driver::Driver;
use rapid_registry::device::DeviceNode;
use rapid_registry::simulation::SimDevice;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

use crate::Failure;
use crate::drawn;
use crate::feed::{self, Feed};
use crate::heap;
use crate::process::Running;

/// Chunk size in bytes, as in the recorder.
pub(crate) const CHUNK_BYTES: u64 = 1 << 20;
const BUFFER_BYTES: usize = 64 << 10;
/// Time limit of a child in addition to its task.
const LIMIT: Duration = Duration::from_secs(120);

/// See the module's comment. Not for use by hand.
#[derive(Debug, Subcommand)]
#[command(hide = true)]
pub(crate) enum Child {
    /// The mcap crate writes the messages of the full load
    #[command(hide = true)]
    Mcap {
        /// Where to
        folder: PathBuf,
        /// How many seconds of them
        seconds: u64,
    },
    /// The simulated devices of the full load are read, and nothing is done with it
    #[command(hide = true)]
    Devices {
        /// How long
        seconds: u64,
    },
    /// A policy computes chunks, and reports what memory it kept
    #[command(hide = true)]
    Chunks {
        /// Of the policy
        bundle: PathBuf,
        /// How many
        count: usize,
    },
    /// A monitor shows simulated hours, and reports what memory it kept
    #[command(hide = true)]
    Hours {
        /// Seconds before the first report
        first: u64,
        /// Seconds in all
        all: u64,
    },
}

/// Resources that a child reports.
#[derive(Debug, Default, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Spent {
    /// Time on processors, s.
    pub cpu_s: f64,
    /// Wall time, s.
    pub seconds: f64,
    /// Peak of resident memory, bytes; filled in by the parent.
    #[serde(default)]
    pub resident: u64,
}

impl Spent {
    /// Runs a child and reads its report.
    pub(crate) fn of(command: &mut Command) -> Result<Self, Failure> {
        let usage = Running::start(command)?.finish(LIMIT, || {})?;
        let spent: Self = serde_json::from_str(&usage.output)?;
        Ok(Self { resident: spent.resident.max(usage.resident), ..spent })
    }
}

impl Child {
    /// Runs the task and reports the resources used.
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let printed = match self {
            Self::Mcap { folder, seconds } => serde_json::to_string(&mcap_alone(folder, *seconds)?)?,
            Self::Devices { seconds } => serde_json::to_string(&devices_alone(*seconds)?)?,
            Self::Hours { first, all } => serde_json::to_string(&drawn::kept(*first, *all)?)?,
            Self::Chunks { bundle, count } => serde_json::to_string(&heap::grown(bundle, *count)?)?,
        };
        Ok(writeln!(std::io::stdout(), "{printed}")?)
    }
}

/// Options of a file, as in the recorder.
pub(crate) fn options() -> WriteOptions {
    WriteOptions::new().compression(None).chunk_size(Some(CHUNK_BYTES)).disable_seeking(true)
}

/// Processor time of this process, s.
pub(crate) fn process_cpu_s() -> f64 {
    seconds_of(ClockId::ProcessCPUTime)
}

/// Processor time of this thread, s.
pub(crate) fn thread_cpu_s() -> f64 {
    seconds_of(ClockId::ThreadCPUTime)
}

fn seconds_of(clock: ClockId) -> f64 {
    let time = clock_gettime(clock);
    time.tv_sec as f64 + time.tv_nsec as f64 / 1e9
}

/// A file of the `mcap` crate with the channels of a feed.
pub(crate) struct Plain {
    writer: mcap::Writer<NoSeek<BufWriter<File>>>,
    channels: Vec<u16>,
    numbers: Vec<u32>,
}

impl Plain {
    /// Creates the file.
    pub(crate) fn create(path: &Path, feed: &Feed, options: WriteOptions) -> Result<Self, Failure> {
        let sink = NoSeek::new(BufWriter::with_capacity(BUFFER_BYTES, File::create(path)?));
        let mut writer = mcap::Writer::with_options(sink, options)?;
        let mut channels = Vec::new();
        for lane in feed.lanes.iter() {
            let schema = feed::schema_of(lane);
            let schema = writer.add_schema(schema.name, "protobuf", schema.data)?;
            channels.push(writer.add_channel(schema, &lane.name, "protobuf", &BTreeMap::new())?);
        }
        Ok(Self { numbers: vec![0; channels.len()], channels, writer })
    }

    /// Writes the next message of a lane.
    pub(crate) fn write(&mut self, feed: &Feed, lane: usize) -> Result<(), Failure> {
        let (sequence, channel_id) = (self.numbers[lane], self.channels[lane]);
        let now = Stamp::now().0;
        let header = MessageHeader { channel_id, sequence, log_time: now, publish_time: now };
        let messages = &feed.lanes[lane].messages;
        self.writer.write_to_known_channel(&header, &messages[sequence as usize % messages.len()])?;
        self.numbers[lane] += 1;
        Ok(())
    }

    /// Finishes the file without waiting for the disk.
    pub(crate) fn finish(mut self) -> Result<(), Failure> {
        self.writer.finish()?;
        self.writer.into_inner().into_inner().flush()?;
        Ok(())
    }
}

fn mcap_alone(folder: &Path, seconds: u64) -> Result<Spent, Failure> {
    let feed = Feed::full_load()?;
    let path = folder.join("mcap-alone.mcap");
    let (begun, cpu) = (Instant::now(), process_cpu_s());
    let mut plain = Plain::create(&path, &feed, options())?;
    for _ in 0..seconds {
        for lane in feed.second.iter() {
            plain.write(&feed, *lane)?;
        }
    }
    plain.finish()?;
    let spent = Spent { cpu_s: process_cpu_s() - cpu, seconds: begun.elapsed().as_secs_f64(), resident: peak() };
    std::fs::remove_file(path)?;
    Ok(spent)
}

/// Peak of this process's resident memory, bytes.
fn peak() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok()).map_or(0, |kilobytes| kilobytes << 10)
}

fn devices_alone(seconds: u64) -> Result<Spent, Failure> {
    let (registry, scenario) = feed::rig()?;
    // Configured as in the program.
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let begun = Stamp::now();
        let mut drivers = Vec::new();
        for device in scenario.devices {
            let spec = registry.named(&device.name).ok_or("a device without entry")?;
            let node = DeviceNode::Sim(Arc::new(SimDevice::new(&device.name, device.source, begun)));
            drivers.push(Driver::open(spec, &node).await?);
        }
        let (begun, cpu) = (Instant::now(), process_cpu_s());
        let end = tokio::time::Instant::now() + Duration::from_secs(seconds);
        let readers = drivers.into_iter().map(|mut driver| {
            tokio::spawn(async move {
                let work = async { while driver.read().await.is_ok() {} };
                // It ends by reaching its time limit.
                let _ = tokio::time::timeout_at(end, work).await;
            })
        });
        for reader in readers.collect::<Vec<_>>() {
            reader.await?;
        }
        Ok(Spent { cpu_s: process_cpu_s() - cpu, seconds: begun.elapsed().as_secs_f64(), resident: 0 })
    })
}
