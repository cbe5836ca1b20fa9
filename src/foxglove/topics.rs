//! The topics as clients see them: the channels of an episode's file, and the observations. The frame index lasts from the
//! beginning of an episode to its end.
//!
//! Invariant: schema, metadata and bytes are those of the file.
//! Invariant: what belongs to a channel without a subscriber is not encoded.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use foxglove::{Context, PartialMetadata, RawChannel, Schema as ChannelSchema};
use rapid_bus::TopicId;
use rapid_core::action::ACTION_TOPIC;
use rapid_core::mask::{Bits, MASK_TOPIC};
use rapid_core::modality::MAX_MODALITIES;
use rapid_core::observation::{OBSERVATION_TOPIC, Observation};
use rapid_core::sample::SampleHeader;
use rapid_core::text;
use rapid_core::time::{Stamp, WallClock};
use rapid_core::topic::{EVENT_TOPIC, FRAME_TOPIC, LOG_TOPIC};
use rapid_episode::channel;
use rapid_episode::encode::{self, Announced, logged};
use rapid_episode::form::{Derived, TRANSFORM_TOPIC};
use rapid_episode::made::{Made, MadeKind};
use rapid_episode::schema::{self, PROTOBUF, SampleSchema, Schema};
use rapid_registry::{DeviceSpec, Form, Registry};
use rapid_status::Event;

use super::pictures::RateLimit;

/// Time between two messages about where a sensor sits.
const PLACES_EVERY: Duration = Duration::from_secs(1);

pub(super) struct Topics {
    context: Arc<Context>,
    tracks: Vec<Option<Track>>,
    mask: Option<Arc<RawChannel>>,
    observation: Option<Arc<RawChannel>>,
    frame: Option<Arc<RawChannel>>,
    /// None before the first transform: without a pose in the registry, until the place of a sensor is known.
    transforms: Option<Arc<RawChannel>>,
    event: Option<Arc<RawChannel>>,
    log: Option<Arc<RawChannel>>,
    /// None without an actuator in the registry.
    action: Option<Arc<RawChannel>>,
    /// Where the sensors of the mounted modules sit: the transforms of the newest episode.
    places: Vec<Made>,
    places_sent: Stamp,
    message: Vec<u8>,
    /// Pictures that were left out, and events that were missed, since the last report.
    left_out: LeftOut,
}

#[derive(Debug, Default)]
struct LeftOut {
    pictures: u64,
    events: u64,
}

/// The channels of one modality: one, unless its device sends what the registry did not announce.
struct Track {
    name: String,
    topic: String,
    metadata: BTreeMap<String, String>,
    channels: [Option<Arc<RawChannel>>; SampleSchema::COUNT],
    form: Option<Form>,
    derived: Vec<(Derived, Arc<RawChannel>)>,
    pace: RateLimit,
    /// The newest picture that was not sent yet: its schema and its log time.
    waiting: Option<(SampleSchema, u64)>,
    /// Its message.
    picture: Vec<u8>,
}

impl Topics {
    /// The topics of `registry`.
    pub(super) fn advertise(context: &Arc<Context>, registry: &Registry) -> Self {
        let none = BTreeMap::new();
        let own = |schema, topic| advertise(context, schema, topic, &none);
        let action = registry.actuator().and_then(|(device, action)| {
            let metadata = channel::of_action(device, action);
            advertise(context, SampleSchema::Scalars.schema(), ACTION_TOPIC, &metadata)
        });
        let mut topics = Self {
            context: Arc::clone(context),
            tracks: std::iter::repeat_with(|| None).take(MAX_MODALITIES).collect(),
            mask: own(schema::MASK, MASK_TOPIC),
            observation: own(schema::FRAME, OBSERVATION_TOPIC),
            frame: own(schema::FRAME, FRAME_TOPIC),
            transforms: None,
            event: own(schema::EVENT, EVENT_TOPIC),
            log: own(schema::LOG, LOG_TOPIC),
            action,
            places: Vec::new(),
            places_sent: Stamp::default(),
            message: Vec::new(),
            left_out: LeftOut::default(),
        };
        registry.devices.iter().for_each(|device| topics.add(device));
        topics
    }

    /// Also the topic of this entry.
    pub(super) fn add(&mut self, device: &DeviceSpec) {
        let mut track = Track {
            name: device.name.clone(),
            topic: device.topic.clone(),
            metadata: channel::of_device(device),
            channels: [const { None }; SampleSchema::COUNT],
            form: device.form.clone(),
            derived: Vec::new(),
            pace: RateLimit::default(),
            waiting: None,
            picture: Vec::new(),
        };
        track.channel(&self.context, SampleSchema::expected(device));
        for derived in Derived::for_device(device) {
            let made = || {
                let metadata = channel::of_derived(device, *derived);
                advertise(&self.context, derived.schema(), &derived.topic(device), &metadata)
            };
            let channel = match derived {
                Derived::Transform => self.transforms.clone().or_else(made),
                Derived::Pose | Derived::Joints | Derived::Calibration | Derived::Points => made(),
            };
            if *derived == Derived::Transform {
                self.transforms.clone_from(&channel);
            }
            track.derived.extend(channel.map(|channel| (*derived, channel)));
        }
        if let Some(place) = self.tracks.get_mut(device.id.index()) {
            *place = Some(track);
        }
    }

    /// Sends a sample to those who subscribe to its topic; a picture by [`Self::send_pictures`].
    pub(super) fn send_sample(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8], clock: WallClock) {
        let log_time = clock.wall_ns(Stamp(header.capture_ns));
        let message = &mut self.message;
        match topic {
            TopicId::Modality(id) => {
                let Some(Some(track)) = self.tracks.get_mut(id.index()) else { return };
                self.left_out.pictures += track.send(&self.context, message, (header, payload), log_time);
            }
            TopicId::Mask => {
                let Some(channel) = wanted(self.mask.as_ref()) else { return };
                if let Some((bits, sequence)) = Bits::of_payload(payload) {
                    encode::mask(message, log_time, bits, sequence);
                    send(channel, message, log_time);
                }
            }
            TopicId::Action => {
                let Some(channel) = wanted(self.action.as_ref()) else { return };
                if SampleSchema::for_sample(header, payload) == SampleSchema::Scalars {
                    encode::sample(message, SampleSchema::Scalars, log_time, "", header, payload);
                    send(channel, message, log_time);
                }
            }
            TopicId::Observation => {
                let Some(channel) = wanted(self.observation.as_ref()) else { return };
                if let Some(observation) = Observation::decode(Stamp(header.capture_ns), payload) {
                    encode::frame(message, log_time, header.seq, &observation);
                    send(channel, message, log_time);
                }
            }
        }
    }

    /// Sends the newest picture of each camera, if it is due.
    pub(super) fn send_pictures(&mut self) {
        for track in self.tracks.iter_mut().flatten() {
            let Some((schema, log_time)) = track.waiting.take() else { continue };
            if let Some(Some(channel)) = track.channels.get(schema.index()) {
                send(channel, &track.picture, log_time);
            }
        }
    }

    /// Sends an event, and a line of the log.
    pub(super) fn event(&mut self, event: &Event, clock: WallClock) {
        let (log_time, message) = (clock.wall_ns(event.stamp), &mut self.message);
        // What has no JSON is in no file either, and the recorder reports it.
        if let Some(channel) = wanted(self.event.as_ref())
            && let Ok(announced) = Announced::new(event)
        {
            encode::event(message, log_time, &announced.fields());
            send(channel, message, log_time);
        }
        if let Some(channel) = wanted(self.log.as_ref())
            && let Some((level, text)) = logged(event)
        {
            encode::log(message, log_time, level, text);
            send(channel, message, log_time);
        }
    }

    /// Sends what the recorder made; where sensors sit, by [`Self::send_places`].
    pub(super) fn made(&mut self, made: &Made) {
        match made.kind {
            MadeKind::Frame => {
                if let Some(channel) = wanted(self.frame.as_ref()) {
                    send(channel, made.message(), made.log_time);
                }
            }
            MadeKind::Beginning => self.places.clear(),
            MadeKind::Transform => {
                // Modules may be added during the run.
                if self.transforms.is_none() {
                    self.transforms = advertise(&self.context, schema::TRANSFORM, TRANSFORM_TOPIC, &BTreeMap::new());
                }
                self.places.push(*made);
                self.places_sent = Stamp::default();
            }
        }
    }

    /// Sends where sensors sit, again and again: a client that connects later needs it too.
    pub(super) fn send_places(&mut self, now: Stamp) {
        if now.since(self.places_sent) < PLACES_EVERY {
            return;
        }
        self.places_sent = now;
        let Some(channel) = wanted(self.transforms.as_ref()) else { return };
        for made in &self.places {
            send(channel, made.message(), made.log_time);
        }
    }

    pub(super) const fn missed(&mut self, count: u64) {
        self.left_out.events = self.left_out.events.saturating_add(count);
    }

    /// What was left out since the last call, if anything was.
    pub(super) fn left_out(&mut self) -> Option<String> {
        let LeftOut { pictures, events } = std::mem::take(&mut self.left_out);
        let parts = [(pictures, "picture"), (events, "event")];
        let parts: Vec<_> =
            parts.iter().filter(|(count, _)| *count > 0).map(|(count, of)| text::counted(*count, of)).collect();
        (!parts.is_empty()).then(|| format!("{} not sent: they came faster than they are shown", parts.join(", ")))
    }
}

impl Track {
    fn channel(&mut self, context: &Arc<Context>, schema: SampleSchema) -> Option<&Arc<RawChannel>> {
        let place = self.channels.get_mut(schema.index())?;
        if place.is_none() {
            *place = advertise(context, schema.schema(), &self.topic, &self.metadata);
        }
        place.as_ref()
    }

    /// Returns how many pictures were left out.
    fn send(
        &mut self,
        context: &Arc<Context>,
        message: &mut Vec<u8>,
        (header, payload): (&SampleHeader, &[u8]),
        log_time: u64,
    ) -> u64 {
        let schema = SampleSchema::for_sample(header, payload);
        if let Some(form) = &self.form {
            for (derived, channel) in self.derived.iter().filter(|(_, channel)| channel.has_sinks()) {
                if derived.encode(message, log_time, &self.name, form, (schema, payload)) {
                    send(channel, message, log_time);
                }
            }
        }
        if wanted(self.channel(context, schema)).is_none() {
            return 0;
        }
        if matches!(schema, SampleSchema::Scalars | SampleSchema::Bytes) {
            encode::sample(message, schema, log_time, &self.name, header, payload);
            if let Some(channel) = self.channel(context, schema) {
                send(channel, message, log_time);
            }
            return 0;
        }
        if !self.pace.admits(Stamp(header.capture_ns)) {
            return 1;
        }
        encode::sample(&mut self.picture, schema, log_time, &self.name, header, payload);
        u64::from(self.waiting.replace((schema, log_time)).is_some())
    }
}

/// A new channel. None is refused: each has an encoding.
fn advertise(
    context: &Arc<Context>,
    schema: Schema,
    topic: &str,
    metadata: &BTreeMap<String, String>,
) -> Option<Arc<RawChannel>> {
    let channel = context
        .channel_builder(topic)
        .message_encoding(PROTOBUF)
        .schema(ChannelSchema::new(schema.name, PROTOBUF, schema.data))
        .metadata(metadata.clone())
        .build_raw();
    channel.inspect_err(|error| tracing::error!(%error, topic, "Foxglove: a topic is not shown")).ok()
}

/// The channel, if a client subscribes to it.
fn wanted(channel: Option<&Arc<RawChannel>>) -> Option<&Arc<RawChannel>> {
    channel.filter(|channel| channel.has_sinks())
}

fn send(channel: &RawChannel, message: &[u8], log_time: u64) {
    channel.log_with_meta(message, PartialMetadata::with_log_time(log_time));
}
