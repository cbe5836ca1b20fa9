//! The MCAP file of an episode: its channels and what is written to them.
//!
//! Invariant: every channel that the registry declares is in the file from the start, so that a modality that never
//! appears is still named.
//! Invariant: only whole chunks reach the file: after a crash it ends between two records, unless the crash interrupted
//! a write. Each chunk can be read without the others.
//! Invariant: only [`EpisodeFile::finish`] gives a file its end; after an error it never gets one.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use mcap::Attachment;
use mcap::records::MessageHeader;
use rapid_core::action::ACTION_TOPIC;
use rapid_core::mask::{Bits, MASK_TOPIC};
use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::observation::Observation;
use rapid_core::sample::SampleHeader;
use rapid_core::time::{Stamp, WallClock};
use rapid_core::topic::{EVENT_TOPIC, FRAME_TOPIC, LOG_TOPIC};
use rapid_registry::{Form, ModuleSpec, Registry, TransformSpec};
use rapid_status::Level;
use rapid_system::disk::FileLimit;

use super::tampering::FileWatch;
use crate::chunk_writer::{self, ChunkWriter, Sink, io_error};
use crate::encode::{self, EventText};
use crate::episode_id::EpisodeId;
use crate::form::{Derived, TRANSFORM_TOPIC};
use crate::made::{MadeKind, Shown};
use crate::reference::{self, ReferenceSample};
use crate::schema::{self, PROTOBUF, SampleSchema, Schema};
use crate::{ABOUT, SUMMARY, channel};

/// Bytes for the end of a file beside its index: frames and events of the last second, and the verdict.
const FOR_END: u64 = 1 << 20;

pub(super) struct EpisodeFile {
    /// Declared before the writer, which writes its own end when dropped.
    #[expect(dead_code, reason = "held to be dropped")]
    shut: Shut,
    writer: ChunkWriter<Latch>,
    /// Bytes that the sink took.
    written: Arc<AtomicU64>,
    /// How large it may become.
    limit: FileLimit,
    /// Checks at every flush and at the end whether another program has damaged the file.
    tampering: FileWatch,
    /// Where what only it writes is shown.
    shown: Option<Shown>,
    clock: WallClock,
    message: Vec<u8>,
    tracks: Vec<Option<Track>>,
    mask: u16,
    /// None without an actuator in the registry.
    action: Option<u16>,
    frame: u16,
    event: u16,
    log: u16,
    pub(super) messages: u64,
    /// Payload bytes of samples written.
    pub(super) bytes: u64,
}

/// Shuts its [`Latch`] when it is dropped.
#[derive(Default)]
struct Shut(Arc<AtomicBool>);

impl Drop for Shut {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// A sink that accepts nothing after its first error, or once it is shut: the writer and its buffer retry when dropped,
/// and a footer after a gap would make the file look whole.
struct Latch {
    sink: Box<dyn Sink>,
    shut: Arc<AtomicBool>,
    written: Arc<AtomicU64>,
}

impl Latch {
    fn run<T>(&mut self, work: impl FnOnce(&mut dyn Sink) -> io::Result<T>) -> io::Result<T> {
        if self.shut.load(Ordering::Relaxed) {
            return Err(io::Error::other("given up after an error"));
        }
        let taken = work(&mut *self.sink);
        if taken.as_ref().is_err_and(|error| error.kind() != io::ErrorKind::Interrupted) {
            self.shut.store(true, Ordering::Relaxed);
        }
        taken
    }
}

impl Write for Latch {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let taken = self.run(|sink| sink.write(bytes))?;
        self.written.fetch_add(taken as u64, Ordering::Relaxed);
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.run(|sink| sink.flush())
    }
}

impl Sink for Latch {
    fn sync(&mut self) -> io::Result<()> {
        self.run(|sink| sink.sync())
    }
}

/// The channels of one modality: one, unless its device sends what the registry did not announce.
struct Track {
    name: String,
    topic: String,
    metadata: BTreeMap<String, String>,
    channels: [Option<u16>; SampleSchema::COUNT],
    /// What its numbers mean, and the channels of the messages derived from them.
    form: Option<Form>,
    derived: Vec<(Derived, u16)>,
    /// Its newest message, and the position of the sample in it.
    message: Vec<u8>,
    newest: Option<Range<usize>>,
}

impl EpisodeFile {
    /// Begins a file: header, metadata, `devices.toml`, channels.
    pub(super) fn begin(
        sink: Box<dyn Sink>,
        registry: &Registry,
        clock: WallClock,
        begin: Stamp,
        metadata: BTreeMap<String, String>,
        tampering: FileWatch,
        shown: Option<Shown>,
    ) -> io::Result<Self> {
        let (shut, written) = (Shut::default(), Arc::<AtomicU64>::default());
        let wall_ns = clock.wall_ns(begin);
        let latch = Latch { sink, shut: Arc::clone(&shut.0), written: Arc::clone(&written) };
        let mut writer = ChunkWriter::new(latch, Some(EpisodeId::new(wall_ns, begin.0)))?;
        writer.metadata(ABOUT, metadata).map_err(io_error)?;
        writer
            .attach(&Attachment {
                log_time: wall_ns,
                create_time: wall_ns,
                name: "devices.toml".to_owned(),
                media_type: "application/toml".to_owned(),
                data: registry.text.as_bytes().into(),
            })
            .map_err(io_error)?;

        let none = BTreeMap::new();
        let mask = add_channel(&mut writer, schema::MASK, MASK_TOPIC, &none)?;
        let frame = add_channel(&mut writer, schema::FRAME, FRAME_TOPIC, &none)?;
        let event = add_channel(&mut writer, schema::EVENT, EVENT_TOPIC, &none)?;
        let log = add_channel(&mut writer, schema::LOG, LOG_TOPIC, &none)?;
        let action = match registry.actuator() {
            Some((device, action)) => {
                let metadata = channel::of_action(device, action);
                Some(add_channel(&mut writer, SampleSchema::Scalars.schema(), ACTION_TOPIC, &metadata)?)
            }
            None => None,
        };
        let mut tracks = Vec::new();
        tracks.resize_with(MAX_MODALITIES, || None);
        let mut file = Self {
            shut,
            writer,
            written,
            limit: FileLimit::NONE,
            tampering,
            shown,
            clock,
            message: Vec::new(),
            tracks,
            mask,
            action,
            frame,
            event,
            log,
            messages: 0,
            bytes: 0,
        };
        for device in &registry.devices {
            let metadata = channel::of_device(device);
            let (name, topic) = (device.name.clone(), device.topic.clone());
            // Grows to the largest sample: the maximum of the registry is usually far more.
            let (message, newest) = (Vec::new(), None);
            let (channels, form, derived) = ([None; SampleSchema::COUNT], device.form.clone(), Vec::new());
            let mut track = Track { name, topic, metadata, channels, form, derived, message, newest };
            track.channel(&mut file.writer, SampleSchema::expected(device))?;
            for derived in Derived::for_device(device) {
                let metadata = channel::of_derived(device, *derived);
                let channel = add_channel(&mut file.writer, derived.schema(), &derived.topic(device), &metadata)?;
                track.derived.push((*derived, channel));
            }
            if let Some(place) = file.tracks.get_mut(device.id.index()) {
                *place = Some(track);
            }
        }
        Ok(file)
    }

    /// The same, which may grow to `limit`.
    pub(super) fn limited(self, limit: FileLimit) -> Self {
        Self { limit, ..self }
    }

    /// Why `bytes` more of a sample, and then its end, do not fit into the file; `None` if they do.
    pub(super) fn full(&self, bytes: usize) -> Option<FileLimit> {
        let written = self.written.load(Ordering::Relaxed);
        // A sample whose form is known is written twice.
        let more = (bytes as u64).saturating_mul(2).saturating_add(FOR_END);
        let needed = written.saturating_add(self.writer.outstanding()).saturating_add(more);
        (needed > self.limit.bytes).then_some(self.limit)
    }

    /// Is this, byte for byte, the newest sample of the modality? Compared with the written message; a copy would cost
    /// as much as writing it.
    pub(super) fn repeats(&self, id: ModalityId, payload: &[u8]) -> bool {
        let Some(Some(track)) = self.tracks.get(id.index()) else { return false };
        track.newest.clone().and_then(|place| track.message.get(place)) == Some(payload)
    }

    /// Writes a sample; one of a modality that is not registered is not written.
    pub(super) fn sample(&mut self, id: ModalityId, header: &SampleHeader, payload: &[u8]) -> io::Result<()> {
        let Some(Some(track)) = self.tracks.get_mut(id.index()) else { return Ok(()) };
        let schema = SampleSchema::for_sample(header, payload);
        let channel = track.channel(&mut self.writer, schema)?;
        let log_time = self.clock.wall_ns(Stamp(header.capture_ns));
        track.newest = Some(encode::sample(&mut track.message, schema, log_time, &track.name, header, payload));
        self.bytes += payload.len() as u64;
        let message = message_header(channel, header.seq, log_time, self.clock.wall_ns(Stamp(header.recv_ns)));
        self.writer.message(&message, &track.message).map_err(io_error)?;
        self.messages += 1;
        let Track { name, form: Some(form), derived, .. } = track else { return Ok(()) };
        for (derived, channel_id) in derived {
            if derived.encode(&mut self.message, log_time, name, form, (schema, payload)) {
                let message = MessageHeader { channel_id: *channel_id, ..message };
                self.writer.message(&message, &self.message).map_err(io_error)?;
                self.messages += 1;
            }
        }
        Ok(())
    }

    /// Writes a publication of the mask.
    pub(super) fn mask(&mut self, header: &SampleHeader, bits: Bits, sequence: u64) -> io::Result<()> {
        let log_time = self.clock.wall_ns(Stamp(header.capture_ns));
        encode::mask(&mut self.message, log_time, bits, sequence);
        self.write(self.mask, sequence, log_time, Stamp(header.recv_ns))
    }

    /// Writes an action, if the registry has an actuator for it.
    pub(super) fn action(&mut self, header: &SampleHeader, payload: &[u8]) -> io::Result<()> {
        let schema = SampleSchema::for_sample(header, payload);
        let Some(channel) = self.action.filter(|_| schema == SampleSchema::Scalars) else { return Ok(()) };
        let log_time = self.clock.wall_ns(Stamp(header.capture_ns));
        encode::sample(&mut self.message, schema, log_time, "", header, payload);
        self.write(channel, header.seq, log_time, Stamp(header.recv_ns))
    }

    /// Writes a tick of the frame index, for which samples received until `deadline` counted.
    pub(super) fn frame(&mut self, index: u64, observation: &Observation, deadline: Stamp) -> io::Result<()> {
        let log_time = self.clock.wall_ns(observation.tick);
        encode::frame(&mut self.message, log_time, index, observation);
        self.write(self.frame, index, log_time, deadline)?;
        self.show(MadeKind::Frame, log_time);
        Ok(())
    }

    /// Writes where the sensors of these modules sit.
    pub(super) fn transforms<'a>(
        &mut self,
        modules: impl Iterator<Item = &'a ModuleSpec>,
        begin: Stamp,
    ) -> io::Result<()> {
        let log_time = self.clock.wall_ns(begin);
        self.message.clear();
        self.show(MadeKind::Beginning, log_time);
        let mut numbered = (0..).zip(modules.flat_map(|module| &module.transforms)).peekable();
        if numbered.peek().is_none() {
            return Ok(());
        }
        let channel = add_channel(&mut self.writer, schema::TRANSFORM, TRANSFORM_TOPIC, &BTreeMap::new())?;
        for (number, spec) in numbered {
            let TransformSpec { sensor, parent, position, rotation } = spec;
            let pose = encode::Pose { position: *position, rotation: *rotation };
            encode::transform(&mut self.message, log_time, [parent, sensor], &pose);
            self.write(channel, number, log_time, begin)?;
            self.show(MadeKind::Transform, log_time);
        }
        Ok(())
    }

    /// Attaches a sample that the policy compares later ones with.
    pub(super) fn reference(&mut self, sample: &ReferenceSample) -> io::Result<()> {
        let wall_ns = self.clock.wall_ns(Stamp(sample.header.capture_ns));
        let attachment = reference::attachment(&mut self.message, wall_ns, sample);
        self.writer.attach(&attachment).map_err(io_error)
    }

    fn show(&self, kind: MadeKind, log_time: u64) {
        if let Some(shown) = &self.shown {
            shown.show(kind, log_time, &self.message);
        }
    }

    /// Writes an event.
    pub(super) fn event(&mut self, number: u64, stamp: Stamp, text: &EventText<'_>) -> io::Result<()> {
        let log_time = self.clock.wall_ns(stamp);
        encode::event(&mut self.message, log_time, text);
        self.write(self.event, number, log_time, stamp)
    }

    /// Writes a line of the log.
    pub(super) fn log(&mut self, number: u64, stamp: Stamp, level: Level, text: &str) -> io::Result<()> {
        let log_time = self.clock.wall_ns(stamp);
        encode::log(&mut self.message, log_time, level, text);
        self.write(self.log, number, log_time, stamp)
    }

    /// Hands everything written so far to the kernel: from then on it survives the end of this
    /// process. It does not wait for the disk, which may take seconds: what the kernel has not written
    /// back yet a loss of power can take.
    ///
    /// # Errors
    /// When the disk does not take it, or another program has damaged what was written so far.
    pub(super) fn flush(&mut self) -> io::Result<()> {
        self.writer.flush().map_err(io_error)?;
        let written = self.written.load(Ordering::Relaxed);
        self.tampering.check(written)
    }

    /// Ends the file with the summary and waits for the disk. A file that is dropped instead, or
    /// that cannot be ended, stays as it is: nothing more is written to it.
    pub(super) fn finish(mut self, summary: BTreeMap<String, String>) -> io::Result<()> {
        self.writer.metadata(SUMMARY, summary).map_err(io_error)?;
        self.writer.finish()?;
        let written = self.written.load(Ordering::Relaxed);
        self.tampering.verify(written)
    }

    fn write(&mut self, channel_id: u16, sequence: u64, log_time: u64, published: Stamp) -> io::Result<()> {
        let header = message_header(channel_id, sequence, log_time, self.clock.wall_ns(published));
        self.writer.message(&header, &self.message).map_err(io_error)?;
        self.messages += 1;
        Ok(())
    }
}

fn message_header(channel_id: u16, sequence: u64, log_time: u64, publish_time: u64) -> MessageHeader {
    #[expect(clippy::cast_possible_truncation, reason = "MCAP has 32 bits for it: the lower ones")]
    let sequence = sequence as u32;
    MessageHeader { channel_id, sequence, log_time, publish_time }
}

impl Track {
    fn channel(&mut self, writer: &mut ChunkWriter<Latch>, schema: SampleSchema) -> io::Result<u16> {
        if let Some(Some(channel)) = self.channels.get(schema.index()) {
            return Ok(*channel);
        }
        let channel = add_channel(writer, schema.schema(), &self.topic, &self.metadata)?;
        if let Some(place) = self.channels.get_mut(schema.index()) {
            *place = Some(channel);
        }
        Ok(channel)
    }
}

fn add_channel(
    writer: &mut ChunkWriter<Latch>,
    schema: Schema,
    topic: &str,
    metadata: &BTreeMap<String, String>,
) -> io::Result<u16> {
    let schema = writer.schema(None, schema.name, PROTOBUF, schema.data).map_err(io_error)?;
    writer.channel(None, &chunk_writer::Channel { schema, topic, encoding: PROTOBUF, metadata }).map_err(io_error)
}
