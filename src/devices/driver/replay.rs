//! Replay: a recorded episode as a scenario: its mask becomes plugs and unplugs, each topic a device.
//!
//! The file is read one batch of messages ahead on the blocking pool; each message is due at its recorded offset from
//! the scenario's beginning. When the messages are used up the device stays silent, like one that hangs.
//!
//! Invariant: the file is read from start to end, chunk by chunk, and never held whole.
//! Invariant: messages in a damaged chunk are not played.
//! Invariant: a damaged file ends the topic early or omits the damaged part; it never ends the program.

use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::provenance::{KernelDriver, Negotiated, ReplaySource};
use rapid_core::sample::{Encoding, FLAG_DEVICE_TIME};
use rapid_core::time::{Stamp, nanoseconds};
use rapid_episode::MAGIC;
use rapid_episode::decode::{Content, Kind, Sample, Scratch};
use rapid_episode::reader::{Channel, Item, Reader};
use rapid_episode::record::inspect::inspect;
use rapid_episode::record_iter::FileEnd;
use rapid_episode::{ReadAt, ReadError};
use rapid_registry::device::{LanIdentity, UsbIdentity};
use rapid_registry::scenario::{Scenario, ScenarioAction, ScenarioDevice, ScenarioEvent};
use rapid_registry::simulation::{SimDevice, SimFaults, SimSource};
use rapid_registry::{DeviceSpec, Registry};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::sim::stamp_of;
use super::{Agreed, DriverError, Reading, unblock};

/// Messages per read: at 1 kHz this covers the reading of a chunk.
const BATCH: usize = 32;
/// Payload bytes after which a batch is full, for large pictures.
const BATCH_BYTES: usize = 8 << 20;
/// Upper limit for noticing a pulled cable or a silence.
const NOTICE: Duration = Duration::from_millis(10);
/// The first time a device is opened, samples recorded during its opening are still played.
const OPENING: Duration = Duration::from_secs(2);

/// Maximum number of mask changes that are played: a device that flaps at 500 Hz, the rate of the mask, reaches it
/// after half an hour.
const MAX_CHANGES: usize = 1_000_000;
/// How long before its first sample, which sets its bit, a device is attached.
const LEAD: Duration = Duration::from_millis(100);

/// A topic being played.
#[derive(Debug)]
pub struct Replay {
    device: Arc<SimDevice>,
    playing: Vec<Message>,
    /// Index of the next message of `playing`.
    next: usize,
    /// The batch after `playing`; `None` once the file is used up.
    reading: Option<JoinHandle<Batch>>,
    begin_ns: u64,
    pub(super) agreed: Agreed,
}

#[derive(Debug)]
struct Message {
    /// Recorded capture time relative to the episode's beginning.
    after: Duration,
    encoding: Encoding,
    width: u32,
    height: u32,
    payload: Vec<u8>,
}

impl Replay {
    /// Starts playing the device's topic from the scenario's present moment.
    ///
    /// # Errors
    /// When the file cannot be read, has no such topic, or the topic holds no samples.
    pub async fn open(device: Arc<SimDevice>) -> Result<Self, DriverError> {
        let SimSource::Replay { file, topic, begin_ns, of } = device.source.clone() else {
            return Err(DriverError::Fatal(format!("{} is not a recording", device.name)));
        };
        let elapsed = stamp_of(Instant::now()).since(device.begun);
        let is_first = device.sequence.load(Ordering::Acquire) == 0;
        let from = if is_first { elapsed.saturating_sub(OPENING) } else { elapsed };
        let from_ns = begin_ns.saturating_add(nanoseconds(from));
        let description = format!("replay of {topic} in {}", file.display());
        let messages = unblock(move || play(&file, &topic, from_ns)).await?;
        let reading = Some(tokio::task::spawn_blocking(move || batch(messages, begin_ns, Vec::new())));
        // In a recording of the replay the file represents the device.
        let version = Some(env!("CARGO_PKG_VERSION").to_owned());
        let driver = Some(KernelDriver { name: "rapid-replay".to_owned(), version });
        let negotiated =
            Negotiated { driver, bus: Some(description.clone()), replay_of: Some(of), ..Negotiated::default() };
        let agreed = Agreed { description, negotiated };
        Ok(Self { device, playing: Vec::new(), next: 0, reading, begin_ns, agreed })
    }

    /// The next recorded sample, when it is due.
    ///
    /// # Errors
    /// [`DriverError::Gone`] once the cable is pulled.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let captured = self.wait_due().await?;
        // No await from here on: a future dropped earlier has taken no sample.
        self.device.sequence.fetch_add(1, Ordering::AcqRel);
        let Some(&Message { encoding, width, height, ref payload, .. }) = self.playing.get(self.next) else {
            return Err(DriverError::Gone);
        };
        self.next += 1;
        Ok(Reading { bytes: payload, encoding, captured, flags: FLAG_DEVICE_TIME, width, height, lost: 0 })
    }

    /// Waits until the message at `next` is due.
    async fn wait_due(&mut self) -> Result<Stamp, DriverError> {
        loop {
            if self.device.is_unplugged() {
                return Err(DriverError::Gone);
            }
            let now = Instant::now();
            let Some(message) = self.playing.get(self.next) else {
                self.turn_over(now + NOTICE).await;
                continue;
            };
            let due = self.device.begun.after(message.after);
            let now_stamp = stamp_of(now);
            if due > now_stamp {
                tokio::time::sleep_until((now + due.since(now_stamp)).min(now + NOTICE)).await;
            } else if self.device.is_silent() {
                // A sample due during a silence is skipped.
                self.next += 1;
            } else {
                return Ok(due);
            }
        }
    }

    /// Switches to the prefetched batch and starts reading the next one; gives up at `until`.
    async fn turn_over(&mut self, until: Instant) {
        let Some(reading) = &mut self.reading else {
            // The file is used up.
            tokio::time::sleep_until(until).await;
            return;
        };
        // If dropped here, the handle and its batch remain.
        let Ok(read) = tokio::time::timeout_at(until, reading).await else { return };
        self.reading = None;
        // It ends without a batch only when the runtime is shutting down.
        let Ok(Batch { messages, rest }) = read else { return };
        let used = std::mem::replace(&mut self.playing, messages);
        self.next = 0;
        let begin_ns = self.begin_ns;
        self.reading = rest.map(|rest| tokio::task::spawn_blocking(move || batch(rest, begin_ns, used)));
    }
}

/// Messages, and the reader of the following ones; `None` at the end of the file.
#[derive(Debug)]
struct Batch {
    messages: Vec<Message>,
    rest: Option<Messages<File>>,
}

/// The next messages, reusing the memory of `used`; reads the file, on the blocking pool. Stops at the file's end or
/// first damage.
fn batch(mut recorded: Messages<File>, begin_ns: u64, used: Vec<Message>) -> Batch {
    let mut spare = used.into_iter().map(|message| message.payload);
    let (mut messages, mut bytes) = (Vec::with_capacity(BATCH), 0);
    while messages.len() < BATCH && bytes < BATCH_BYTES {
        match recorded.advance() {
            Ok(true) => {}
            Ok(false) => return Batch { messages, rest: None },
            Err(error) => {
                tracing::warn!(%error, "the recording ends early");
                return Batch { messages, rest: None };
            }
        }
        // A message that cannot be read was not recorded by this program; it has no sample to play.
        let Some((log_time, sample)) = recorded.sample() else { continue };
        let mut payload = spare.next().unwrap_or_default();
        payload.clear();
        payload.extend_from_slice(sample.payload);
        bytes += payload.len();
        let after = Duration::from_nanos(log_time.saturating_sub(begin_ns));
        let Sample { encoding, width, height, .. } = sample;
        messages.push(Message { after, encoding, width, height, payload });
    }
    Batch { messages, rest: Some(recorded) }
}

fn fatal(file: &Path, why: impl std::fmt::Display) -> DriverError {
    DriverError::Fatal(format!("{}: {why}", file.display()))
}

impl From<ReadError> for DriverError {
    fn from(error: ReadError) -> Self {
        Self::Fatal(error.to_string())
    }
}

/// Contents of an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeDescription {
    /// Wall time of the first message, ns since 1970.
    pub begin_ns: u64,
    /// Wall time of the last message, ns since 1970.
    pub end_ns: u64,
    /// Topics, by name.
    pub topics: Vec<TopicDescription>,
    /// Names and bits of the modalities, by bit.
    pub layout: Vec<(String, ModalityId)>,
    /// Text of the `devices.toml` it was recorded with.
    pub registry: String,
    /// The mask at its first record and after each change, with wall time in ns, ascending.
    pub mask: Vec<(u64, PhysicalMask)>,
}

/// A topic of an episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicDescription {
    /// Name.
    pub topic: String,
    /// Name of the schema, for example `foxglove.CompressedImage`.
    pub schema: String,
    /// Messages.
    pub messages: u64,
}

/// The contents of `file`. Reads the whole file, a chunk at a time; blocks.
///
/// # Errors
/// When the file cannot be read, or is damaged or was never closed.
pub fn describe(file: &Path) -> Result<EpisodeDescription, DriverError> {
    let collected = Collected::read(open(file)?)?;
    if collected.mask.len() > MAX_CHANGES {
        return Err(fatal(file, "the mask changes more than a million times"));
    }
    if collected.reader.integrity().end != FileEnd::Finished {
        return Err(fatal(file, format!("is damaged; {}", fix(file))));
    }
    collected.description().map_err(|why| fatal(file, why))
}

/// Opens a file that was properly closed.
fn open(path: &Path) -> Result<Reader<File>, DriverError> {
    let (file, size) = rapid_episode::open(path)?;
    let not_mcap = || ReadError::NotMcap(path.to_owned());
    let magic_at = |at| {
        let mut read = [0; MAGIC.len()];
        file.read_exact_at(&mut read, at).map_err(|error| fatal(path, error))?;
        Ok::<_, DriverError>(read == MAGIC)
    };
    let end = size.checked_sub(MAGIC.len() as u64).ok_or_else(not_mcap)?;
    let (is_mcap, is_closed) = (magic_at(0)?, magic_at(end)?);
    if !is_mcap {
        return Err(not_mcap().into());
    }
    if !is_closed {
        return Err(fatal(path, format!("was not closed, and cannot be played; {}", fix(path))));
    }
    Ok(Reader::new(file, size, path, None)?)
}

/// The messages of `topic` in the file at `path`, starting at `from_ns`.
fn play(path: &Path, topic: &str, from_ns: u64) -> Result<Messages<File>, DriverError> {
    let mut messages = Messages::new(open(path)?, topic, from_ns);
    if messages.seek()? {
        return Ok(messages);
    }
    Err(fatal(path, messages.refusal()))
}

fn fix(path: &Path) -> String {
    format!("`rapid recover {}` makes it whole, `rapid inspect` reads what is there", path.display())
}

/// Reads arbitrary `bytes` as replay reads a file: the description and every message that a device could play.
pub fn read_bytes(bytes: &[u8]) {
    let reader = || Reader::new(bytes, bytes.len() as u64, Path::new("bytes.mcap"), None);
    let Ok(Ok(described)) = reader().and_then(Collected::read).map(Collected::description) else { return };
    for topic in described.topics {
        let Ok(reader) = reader() else { return };
        let mut messages = Messages::new(reader, &topic.topic, described.begin_ns);
        while let Ok(true) = messages.advance() {
            let _ = messages.sample();
        }
    }
}

/// Data collected over the whole file.
struct Collected<R> {
    reader: Reader<R>,
    /// Messages by channel.
    messages: BTreeMap<u16, u64>,
    times: Option<(u64, u64)>,
    mask: Vec<(u64, PhysicalMask)>,
}

impl<R: ReadAt> Collected<R> {
    /// Reads to the end, or until the mask has changed too often.
    fn read(reader: Reader<R>) -> Result<Self, ReadError> {
        let mut collected = Self { reader, messages: BTreeMap::new(), times: None, mask: Vec::new() };
        let mut scratch = Scratch::default();
        while collected.mask.len() <= MAX_CHANGES && collected.reader.advance()? {
            let Item::Message(message) = collected.reader.item() else { continue };
            let at = message.log_time;
            *collected.messages.entry(message.channel.id).or_default() += 1;
            let (first, last) = collected.times.unwrap_or((at, at));
            collected.times = Some((first.min(at), last.max(at)));
            if message.channel.kind == Kind::Mask
                && let Some(Content::Mask(mask)) = message.content(&mut scratch)
                && collected.mask.last().is_none_or(|(_, last)| *last != mask)
            {
                collected.mask.push((at, mask));
            }
        }
        Ok(collected)
    }

    fn description(mut self) -> Result<EpisodeDescription, String> {
        let mut topics: BTreeMap<String, TopicDescription> = BTreeMap::new();
        for channel in self.reader.channels() {
            let Channel { id, topic, schema, .. } = channel;
            let described = || TopicDescription { topic: topic.clone(), schema: schema.clone(), messages: 0 };
            let messages = self.messages.get(id).copied().unwrap_or_default();
            topics.entry(topic.clone()).or_insert_with(described).messages += messages;
        }
        let layout = self.reader.about("layout").unwrap_or_default();
        let layout: BTreeMap<String, u8> = if layout.is_empty() {
            BTreeMap::new()
        } else {
            serde_json::from_str(layout).map_err(|error| format!("its metadata cannot be read: {error}"))?
        };
        let mut layout: Vec<_> =
            layout.into_iter().filter_map(|(name, bit)| Some((name, ModalityId::new(bit)?))).collect();
        layout.sort_by_key(|(_, id)| *id);
        // Within our own topics times ascend; other writers' files may differ.
        self.mask.sort_by_key(|(at, _)| *at);
        let (begin_ns, end_ns) = self.times.unwrap_or_default();
        let registry = self.reader.about("registry").unwrap_or_default().to_owned();
        Ok(EpisodeDescription {
            begin_ns,
            end_ns,
            topics: topics.into_values().collect(),
            layout,
            registry,
            mask: self.mask,
        })
    }
}

/// The messages of a topic that a device could play, in the order they were recorded.
#[derive(Debug)]
struct Messages<R> {
    reader: Reader<R>,
    scratch: Scratch,
    topic: String,
    from_ns: u64,
}

impl<R: ReadAt> Messages<R> {
    fn new(reader: Reader<R>, topic: &str, from_ns: u64) -> Self {
        Self { reader, scratch: Scratch::default(), topic: topic.to_owned(), from_ns }
    }

    fn is_playable(&self, channel: &Channel) -> bool {
        channel.topic == self.topic && matches!(channel.kind, Kind::Sample(_))
    }

    /// Reads up to a channel of the topic that can be played; returns whether one exists.
    fn seek(&mut self) -> Result<bool, ReadError> {
        while self.reader.advance()? {
            if matches!(self.reader.item(), Item::Channel(channel) if self.is_playable(channel)) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Moves to the next message; `false` at the end.
    fn advance(&mut self) -> Result<bool, ReadError> {
        while self.reader.advance()? {
            if let Item::Message(message) = self.reader.item()
                && message.log_time >= self.from_ns
                && self.is_playable(message.channel)
            {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// The current message and its time; `None` if it cannot be read.
    fn sample(&mut self) -> Option<(u64, Sample<'_>)> {
        let Item::Message(message) = self.reader.item() else { return None };
        let Some(Content::Sample(sample)) = message.content(&mut self.scratch) else { return None };
        Some((message.log_time, sample))
    }

    /// Why the topic cannot be played.
    fn refusal(&self) -> String {
        let topic = &self.topic;
        if let Some(channel) = self.reader.channels().find(|channel| channel.topic == *topic) {
            return format!("{topic} holds {:?} messages, which no device sends", channel.schema);
        }
        let mut topics: Vec<&str> = self.reader.channels().map(|channel| channel.topic.as_str()).collect();
        topics.sort_unstable();
        topics.dedup();
        format!("has no topic {topic}; it has {}", topics.join(", "))
    }
}

/// A recorded episode, to be played.
#[derive(Debug, Clone, PartialEq)]
pub struct Replayed {
    /// The registry it was recorded with.
    pub registry: Registry,
    /// Each modality is a device that plays its topic and is plugged and unplugged according to the recorded mask.
    pub scenario: Scenario,
    /// Time from its first message to its last.
    pub length: Duration,
}

/// Creates devices from a recorded episode; blocks.
///
/// # Errors
/// When the file cannot be read, or does not hold the registry and the layout.
pub fn scenario(file: &Path) -> Result<Replayed, DriverError> {
    let episode = describe(file)?;
    if episode.layout.is_empty() || episode.registry.is_empty() {
        return Err(fatal(file, "holds no layout and registry: it was not recorded by rapid"));
    }
    let loaded = Registry::parse(&episode.registry, None)
        .map_err(|errors| fatal(file, format!("the registry in it cannot be read: {errors}")))?;
    let registry = loaded.registry;
    let of = Arc::new(source(file, episode.begin_ns)?);
    let device = |spec: &DeviceSpec| ScenarioDevice {
        name: spec.name.clone(),
        usb: usb_identity(spec),
        lan: lan_identity(spec),
        source: SimSource::Replay {
            file: file.to_owned(),
            topic: spec.topic.clone(),
            begin_ns: episode.begin_ns,
            of: Arc::clone(&of),
        },
        plugged: episode.mask.first().is_some_and(|(_, mask)| mask.contains(spec.id)),
        faults: SimFaults::default(),
    };
    let mut events: Vec<_> =
        registry.devices.iter().flat_map(|spec| plug_events(&episode, &spec.name, spec.id)).collect();
    events.sort_by_key(|event| event.at);
    let devices = registry.devices.iter().map(device).collect();
    let length = Duration::from_nanos(episode.end_ns.saturating_sub(episode.begin_ns));
    Ok(Replayed { registry, scenario: Scenario { devices, events, repeat: None }, length })
}

/// What a recording of the replay states about the episode: a replay is no better than what is replayed.
fn source(file: &Path, begin_ns: u64) -> Result<ReplaySource, DriverError> {
    let judgement = inspect(file)?.verdict;
    let verdict = judgement.grade().map_or(String::new(), |grade| grade.word().to_owned());
    let reasons = judgement.reasons().into_iter().map(str::to_owned).collect();
    Ok(ReplaySource { file: file.display().to_string(), begin_ns, verdict, reasons })
}

/// Plugs and unplugs of one modality, from the changes of its bit.
fn plug_events(episode: &EpisodeDescription, name: &str, id: ModalityId) -> Vec<ScenarioEvent> {
    let mut events: Vec<ScenarioEvent> = Vec::new();
    for pair in episode.mask.windows(2) {
        let [(_, before), (time, after)] = pair else { continue };
        let at = Duration::from_nanos(time.saturating_sub(episode.begin_ns));
        let earliest = events.last().map_or(Duration::ZERO, |event| event.at);
        let (at, action) = match (before.contains(id), after.contains(id)) {
            (false, true) => (at.saturating_sub(LEAD).max(earliest), ScenarioAction::Plug { port: None }),
            (true, false) => (at, ScenarioAction::Unplug),
            _ => continue,
        };
        events.push(ScenarioEvent { at, device: name.to_owned(), action });
    }
    events
}

/// A device on the network is identified by its entry.
fn lan_identity(spec: &DeviceSpec) -> Option<LanIdentity> {
    let found = || LanIdentity { entry: spec.name.clone(), address: String::from("replay"), instance: None };
    spec.identity.usb().is_none().then(found)
}

/// The identity of the entry; a port is invented if it has none.
fn usb_identity(spec: &DeviceSpec) -> UsbIdentity {
    let identity = spec.identity.usb();
    UsbIdentity {
        vid: identity.map_or(0, |usb| usb.vid),
        pid: identity.map_or(0, |usb| usb.pid),
        serial: spec.identity.serial().map(str::to_owned),
        port: identity.and_then(|usb| usb.port.clone()).unwrap_or_else(|| format!("9-{}", spec.id.bit() + 1)),
        product: Some(String::from("replay")),
        ..UsbIdentity::default()
    }
}

#[cfg(test)]
mod tests;
