//! The rows of an episode: one for each tick of the frame index, with the sample of each modality that belongs to it.
//!
//! The file is read twice: for the frames, which are small, and for the samples that they name, each of which is kept
//! until the last row that needs it.
//!
//! Invariant: a row shows a modality only if its bit is set at the tick, the frame names a sample and the file has it.
//! Invariant: all samples that rows show of a modality have one form, that of most of its samples. One sample that is
//! otherwise decides about its own row, and not about the episode.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::io;
use std::ops::Range;
use std::path::Path;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};

use rapid_core::action::ACTION_TOPIC;
use rapid_core::modality::{ModalityId, ModalityKind};
use rapid_core::sample::Encoding;
use rapid_core::text;
use rapid_core::topic::FRAME_TOPIC;
use rapid_episode::decode::{Content, FrameSlot, Kind, Sample, Scratch};
use rapid_episode::reader::{Channel, Item, Reader};
use rapid_episode::{ABOUT, ReadError};
use rapid_registry::columns::ColumnError;
use rapid_status::Grade;

use super::picture::{self, Shape};

/// Bytes of samples that may wait for their frame: a minute of four cameras, where a second is usual.
const MOST_WAITING: usize = 1 << 30;
/// Numbers that a registry may declare of a sample; what a file claims may be anything.
pub(super) const LONGEST: usize = 1 << 16;
/// No registry is longer; the text of a hostile file may be.
const LONGEST_REGISTRY: usize = 1 << 20;

/// Why an episode, or the rest of it, is not exported. Without the name of the file.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// It cannot be read.
    #[error("{}", without_name(.0))]
    Read(#[from] ReadError),
    /// It cannot be read to the end.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Another program wrote it.
    #[error("not an episode of rapid")]
    NotOurs,
    /// Its recorder did not end it.
    #[error("unfinished: `rapid recover` makes an episode of it")]
    Unfinished,
    /// A part of it is left out by every reader.
    #[error("damaged ({0}): `rapid recover` saves its readable data to a new file")]
    Damaged(String),
    /// Its verdict.
    #[error("BAD ({0}); --include-bad exports it nevertheless")]
    Bad(String),
    /// Its verdict is not one that was selected.
    #[error("{}", .0.word())]
    NotSelected(Grade),
    /// A value of its metadata.
    #[error("metadata record `{ABOUT}`, key `{key}`: {problem}")]
    Metadata {
        /// The key.
        key: &'static str,
        /// What is wrong with it.
        problem: String,
    },
    /// Observations that are not a whole number a second.
    #[error("{0} observations a second, and LeRobot takes whole numbers only: record with `--rate 30`")]
    Rate(f64),
    /// Without a frame index.
    #[error("no frames: nothing on {FRAME_TOPIC}")]
    NoFrames,
    /// The rows would not be at equal distances.
    #[error(
        "ticks {first} to {last} are missing from the frame index, and the rows of a dataset must be evenly spaced"
    )]
    Hole {
        /// The first tick that is missing.
        first: u64,
        /// The last one.
        last: u64,
    },
    /// Neither a camera nor a vector.
    #[error("neither a camera nor a numeric sensor")]
    Nothing,
    /// A picture that no video can have.
    #[error("{name}: pictures of {shape}, and a video takes even numbers of pixels: --pictures jpeg has no such limit")]
    OddSize {
        /// The camera.
        name: String,
        /// Their size.
        shape: String,
    },
    /// A sensor without any sample, here or in the set.
    #[error("{0}: no usable sample to take the size from, and neither the other episodes nor the registry give it")]
    NoSize(String),
    /// It does not match the other episodes of the set.
    #[error("{0}")]
    Different(String),
    /// What was requested is not in it.
    #[error(transparent)]
    Choice(#[from] ColumnError),
    /// The topic of actions was requested, and has no message.
    #[error(
        "no action was sent in this episode, and {ACTION_TOPIC} is chosen: --action takes numbers of a sensor instead"
    )]
    NoActions,
    /// The frames do not follow their samples.
    #[error("more than {} MiB of samples before the frames that name them", MOST_WAITING >> 20)]
    Order,
    /// Two readings differ.
    #[error("it changed while it was read")]
    Changed,
    /// The user asked for the end.
    #[error("interrupted")]
    Interrupted,
}

/// The reason, without the name that every message of the export has before it.
fn without_name(error: &ReadError) -> String {
    let text = error.to_string();
    match error {
        ReadError::Io { path, .. } | ReadError::NotFile(path) | ReadError::NotMcap(path) => {
            text.strip_prefix(&format!("{}: ", path.display())).map_or(text.clone(), str::to_owned)
        }
    }
}

/// A modality, as the metadata of an episode lists it.
#[derive(Debug, Clone, PartialEq, Eq, serde::Deserialize)]
pub(super) struct Listed {
    pub(super) name: String,
    pub(super) bit: ModalityId,
    pub(super) kind: ModalityKind,
    /// Image: `[height, width]` in pixels. Scalars: `[channels]`. What the registry declares, zeros where it does not.
    #[serde(default)]
    pub(super) shape: Vec<u32>,
    #[serde(default)]
    latency_ns: u64,
}

impl Listed {
    /// The form of its samples by the registry.
    pub(super) fn declared(&self) -> Option<Form> {
        match (self.kind, self.shape.as_slice()) {
            (ModalityKind::Image, [height, width]) => Shape::new(*height, *width, 3).map(Form::Picture),
            (ModalityKind::Scalars, [length, ..]) => Form::of_numbers(usize::try_from(*length).ok()?),
            _ => None,
        }
    }
}

/// What the samples of a modality must have in common to be a feature of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Form {
    Picture(Shape),
    /// How many.
    Numbers(usize),
}

impl Form {
    fn of_numbers(length: usize) -> Option<Self> {
        (1..=LONGEST).contains(&length).then_some(Self::Numbers(length))
    }

    /// Of a sample, as it states it of itself: whether a picture can be used shows later.
    fn of_sample(sample: &Sample<'_>) -> Option<Self> {
        let Sample { encoding, width, height, payload } = *sample;
        match encoding {
            Encoding::F64 => Self::of_numbers(payload.len() / size_of::<f64>()),
            encoding => picture::stated(encoding, width, height, payload).map(Self::Picture),
        }
    }

    const fn is_of(self, kind: ModalityKind) -> bool {
        matches!((self, kind), (Self::Picture(_), ModalityKind::Image) | (Self::Numbers(_), ModalityKind::Scalars))
    }

    /// The one that occurs most often; of those the declared one, else the first.
    pub(super) fn most_frequent(forms: impl Iterator<Item = Self>, declared: Option<Self>) -> Option<Self> {
        // By form: how often, and where first.
        let mut counts: BTreeMap<Self, (usize, usize)> = BTreeMap::new();
        for (at, form) in forms.enumerate() {
            counts.entry(form).or_insert((0, at)).0 += 1;
        }
        let rank = |(form, (count, first)): &(Self, (usize, usize))| (*count, declared == Some(*form), Reverse(*first));
        counts.into_iter().max_by_key(rank).map(|(form, _)| form)
    }
}

impl fmt::Display for Form {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Picture(shape) => write!(f, "a picture of {shape}"),
            Self::Numbers(1) => f.write_str("1 number"),
            Self::Numbers(length) => write!(f, "{length} numbers"),
        }
    }
}

/// Samples of a sensor, or messages of the topic of actions, that no row shows.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Unfit {
    /// The sensor, or the topic.
    pub name: String,
    /// How many rows of the sensor, or messages of the topic.
    pub count: usize,
    /// What is wrong with them.
    pub reason: String,
}

impl fmt::Display for Unfit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, count, reason } = self;
        let unit = if name == ACTION_TOPIC { "message" } else { "frame" };
        write!(f, "{name}: {} ({reason})", text::counted(*count as u64, unit))
    }
}

/// A modality at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Slot {
    pub(super) present: bool,
    /// Its device is plugged in, whether it runs or not.
    pub(super) plugged: bool,
    pub(super) valid: bool,
    pub(super) age_ns: i64,
    /// The sample that belongs to the tick: its place among those of its modality in the file.
    sample: Option<u32>,
}

/// A sample that a row shows.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Payload {
    Picture { encoding: Encoding, width: u32, height: u32, bytes: Vec<u8> },
    Numbers(Vec<f64>),
}

impl Payload {
    fn from_sample(sample: &Sample<'_>) -> Option<Self> {
        match sample.encoding {
            encoding @ (Encoding::Mjpeg | Encoding::Yuyv | Encoding::Grey) => {
                let (width, height) = (sample.width, sample.height);
                Some(Self::Picture { encoding, width, height, bytes: sample.payload.to_owned() })
            }
            Encoding::F64 => Some(Self::Numbers(numbers(sample.payload))),
            // Depth is not an image for LeRobot.
            Encoding::Bytes | Encoding::Mask | Encoding::Depth => None,
        }
    }

    fn size(&self) -> usize {
        match self {
            Self::Picture { bytes, .. } => bytes.len(),
            Self::Numbers(numbers) => 8 * numbers.len(),
        }
    }
}

fn numbers(payload: &[u8]) -> Vec<f64> {
    let (numbers, _) = payload.as_chunks();
    numbers.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect()
}

#[derive(Debug)]
pub(super) struct Row<'a> {
    pub(super) number: usize,
    /// The tick, wall time in ns since 1970.
    pub(super) time_ns: u64,
    /// By modality, ascending by bit.
    pub(super) slots: &'a [Slot],
    /// By modality: its sample, if there is one to show.
    pub(super) samples: &'a [Option<Rc<Payload>>],
    /// The action that belongs to the tick; empty without any.
    pub(super) action: &'a [f64],
}

/// A topic with messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Topic {
    pub(super) name: String,
    /// The modality whose samples it has.
    pub(super) bit: Option<ModalityId>,
    pub(super) kind: Kind,
}

/// The frames of an episode.
#[derive(Debug)]
pub(super) struct Index {
    pub(super) fps: u32,
    pub(super) task: String,
    /// Ascending by bit.
    pub(super) modalities: Vec<Listed>,
    /// Of each row, wall time in ns since 1970.
    pub(super) ticks: Vec<u64>,
    /// Of each row, one for each modality.
    slots: Vec<Slot>,
    /// By modality: the form of the samples that rows show; `None` if none has a form.
    forms: Vec<Option<Form>>,
    /// What has another form, and actions that cannot be used.
    pub(super) unfit: Vec<Unfit>,
    actions: Actions,
    /// Ascending by name.
    pub(super) topics: Vec<Topic>,
    /// The text of the registry that it was recorded with; empty if it carries none.
    pub(super) registry: String,
    /// The names of the axes of an action, as its channel lists them; empty if it does not.
    pub(super) action_names: Vec<String>,
}

/// What was sent to the actuator.
#[derive(Debug, Default)]
struct Actions {
    times: Vec<u64>,
    /// One behind the other, each of `length`.
    values: Vec<f64>,
    length: usize,
}

/// Actions as they are in the file: their time, and where their numbers are.
#[derive(Debug, Default)]
struct Sent {
    all: Vec<(u64, Range<usize>)>,
    values: Vec<f64>,
}

impl Sent {
    fn push(&mut self, time: u64, sample: &Sample<'_>) {
        let begin = self.values.len();
        self.values.extend(numbers(sample.payload));
        self.all.push((time, begin..self.values.len()));
    }

    /// Those that can be used, sorted: of the usual length and finite. Any other moves no motor either; the one before it
    /// stays in force.
    fn usable(self) -> (Actions, Vec<Unfit>) {
        let Self { all, values } = self;
        let of = |range: &Range<usize>| values.get(range.clone()).unwrap_or_default();
        let is_finite = |range: &Range<usize>| of(range).iter().all(|value| value.is_finite());
        let finite = || all.iter().filter(|(_, range)| is_finite(range));
        let form = Form::most_frequent(finite().filter_map(|(_, range)| Form::of_numbers(range.len())), None);
        let Some(Form::Numbers(length)) = form else {
            return (Actions::default(), Unfit::of_actions(all.len(), "no finite number".to_owned()));
        };
        let mut actions = Actions { length, ..Actions::default() };
        for (time, range) in finite().filter(|(_, range)| range.len() == length) {
            actions.times.push(*time);
            actions.values.extend(of(range));
        }
        actions.sort();
        let is_other = |(_, range): &&(u64, Range<usize>)| range.len() != length;
        let reason = match all.iter().find(is_other) {
            Some((_, range)) => format!("{} numbers, and not {length}", range.len()),
            None => "a number that is not finite".to_owned(),
        };
        let unfit = Unfit::of_actions(all.len() - actions.times.len(), reason);
        (actions, unfit)
    }
}

impl Unfit {
    fn of_actions(count: usize, reason: String) -> Vec<Self> {
        let unfit = || Self { name: ACTION_TOPIC.to_owned(), count, reason };
        (count > 0).then(unfit).into_iter().collect()
    }
}

impl Actions {
    /// The action of a tick: the one nearest to it within half a period, as the training of this project chooses them;
    /// without one the last before it, which is still in force, and before all of them the first.
    fn at(&self, tick: u64, period_ns: u64) -> &[f64] {
        // The writer orders actions by their time of receipt, which is that of the file.
        let after = self.times.partition_point(|time| *time < tick);
        let distance = |at: usize| self.times.get(at).map(|time| time.abs_diff(tick));
        let (before, next) = (after.checked_sub(1), distance(after).filter(|ns| *ns < period_ns / 2));
        let chosen = match (before, next) {
            (Some(before), Some(next)) if distance(before).is_some_and(|ns| ns < next) => before,
            (_, Some(_)) | (None, None) => after,
            (Some(before), None) => before,
        };
        self.values.get(chosen * self.length..(chosen + 1) * self.length).unwrap_or_default()
    }

    /// Sorts by time, of equal ones in the order of the file.
    fn sort(&mut self) {
        if self.times.is_sorted() {
            return;
        }
        let mut order: Vec<usize> = (0..self.times.len()).collect();
        order.sort_by_key(|at| self.times.get(*at));
        let value = |at: &usize| self.values.get(at * self.length..(at + 1) * self.length).unwrap_or_default().to_vec();
        self.values = order.iter().flat_map(value).collect();
        self.times.sort_unstable();
    }
}

/// A frame as it is in the file.
struct Frame {
    number: u32,
    time_ns: u64,
    slots: Vec<FrameSlot>,
}

impl Index {
    /// Reads the frames of the episode at `path`.
    pub(super) fn read(path: &Path, stop: &AtomicBool) -> Result<Self, Refusal> {
        let mut reader = Reader::open(path)?;
        let mut scratch = Scratch::default();
        let mut frames = Vec::new();
        let mut sent = Sent::default();
        // By modality, in the order of the file: number and capture time; and the form.
        let mut samples: BTreeMap<ModalityId, Vec<(u32, u64)>> = BTreeMap::new();
        let mut stated: BTreeMap<ModalityId, Vec<Option<Form>>> = BTreeMap::new();
        let mut has_messages = BTreeSet::new();
        while reader.advance()? {
            let Item::Message(message) = reader.item() else { continue };
            has_messages.insert(message.channel.id);
            match message.channel.kind {
                Kind::Frame => {
                    check(stop)?;
                    if let Some(Content::Frame(slots)) = message.content(&mut scratch) {
                        let (number, time_ns) = (message.sequence, message.log_time);
                        frames.push(Frame { number, time_ns, slots: slots.to_vec() });
                    }
                }
                Kind::Sample(_) => {
                    let Some(Content::Sample(sample)) = message.content(&mut scratch) else { continue };
                    if let Some(id) = message.channel.bit {
                        samples.entry(id).or_default().push((message.sequence, message.log_time));
                        stated.entry(id).or_default().push(Form::of_sample(&sample));
                    } else if message.channel.topic == ACTION_TOPIC && sample.encoding == Encoding::F64 {
                        sent.push(message.log_time, &sample);
                    }
                }
                Kind::Mask | Kind::Event | Kind::Other => {}
            }
        }
        let (actions, mut unfit) = sent.usable();
        let of_actions = reader.channels().find(|channel| channel.topic == ACTION_TOPIC);
        let action_names = of_actions.and_then(|channel| serde_json::from_str(channel.names.as_deref()?).ok());
        let topic = |channel: &Channel| Topic { name: channel.topic.clone(), bit: channel.bit, kind: channel.kind };
        let mut topics: Vec<Topic> =
            reader.channels().filter(|channel| has_messages.contains(&channel.id)).map(topic).collect();
        topics.sort_by(|a, b| a.name.cmp(&b.name));
        topics.dedup_by(|a, b| a.name == b.name);
        let registry = reader.about("registry").filter(|text| text.len() <= LONGEST_REGISTRY);
        let registry = registry.unwrap_or_default().to_owned();
        let modalities = modalities(reader.about("modalities"))?;
        let fps = rate(reader.about("observation_hz"))?;
        let task = reader.about("task").unwrap_or_default().to_owned();
        check_ticks(&frames)?;
        let slots = chosen(&modalities, &frames, &samples);
        let ticks = frames.iter().map(|frame| frame.time_ns).collect();
        let forms = forms(&modalities, &slots, &stated, &mut unfit);
        Ok(Self {
            fps,
            task,
            modalities,
            ticks,
            slots,
            forms,
            unfit,
            actions,
            topics,
            registry,
            action_names: action_names.unwrap_or_default(),
        })
    }

    /// The modalities at a row.
    pub(super) fn slots(&self, row: usize) -> &[Slot] {
        let count = self.modalities.len();
        self.slots.get(row * count..(row + 1) * count).unwrap_or_default()
    }

    /// The length of an action; `None` without any.
    pub(super) fn action_length(&self) -> Option<usize> {
        (!self.actions.times.is_empty()).then_some(self.actions.length)
    }

    /// Reads the samples of the episode at `path` and passes every row to `take`, in order, until it fails.
    pub(super) fn rows<E: From<Refusal>>(
        &self,
        path: &Path,
        stop: &AtomicBool,
        mut take: impl FnMut(&Row<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut waiting = Waiting::new(self);
        let mut reader = Reader::open(path).map_err(Refusal::from)?;
        let mut scratch = Scratch::default();
        waiting.flush(&mut take)?;
        while waiting.row < self.ticks.len() && reader.advance().map_err(Refusal::from)? {
            let Item::Message(message) = reader.item() else { continue };
            let (Kind::Sample(_), Some(id)) = (message.channel.kind, message.channel.bit) else { continue };
            let Some(Content::Sample(sample)) = message.content(&mut scratch) else { continue };
            if waiting.push(id, &sample)? {
                check(stop)?;
                waiting.flush(&mut take)?;
            }
        }
        // All samples were there when the frames were read.
        if waiting.row < self.ticks.len() { Err(Refusal::Changed.into()) } else { Ok(()) }
    }
}

fn check(stop: &AtomicBool) -> Result<(), Refusal> {
    if stop.load(Ordering::Relaxed) { Err(Refusal::Interrupted) } else { Ok(()) }
}

fn modalities(text: Option<&str>) -> Result<Vec<Listed>, Refusal> {
    let wrong = |problem| Refusal::Metadata { key: "modalities", problem };
    let text = text.ok_or(Refusal::NotOurs)?;
    let mut listed: Vec<Listed> = serde_json::from_str(text).map_err(|error| wrong(error.to_string()))?;
    listed.sort_by_key(|modality| modality.bit);
    if let Some((first, second)) = pairs(&listed).find(|(first, second)| first.bit == second.bit) {
        return Err(wrong(format!("{} and {} have the same bit", first.name, second.name)));
    }
    // LeRobot takes no such name for a feature.
    match listed.iter().find(|modality| modality.name.is_empty() || modality.name.contains(['/', '.'])) {
        Some(modality) => Err(wrong(format!("{:?} is not the name of a modality", modality.name))),
        None => Ok(listed),
    }
}

fn rate(text: Option<&str>) -> Result<u32, Refusal> {
    let wrong = |problem: &str| Refusal::Metadata { key: "observation_hz", problem: problem.to_owned() };
    let hertz: f64 = text.ok_or_else(|| wrong("missing"))?.parse().map_err(|_| wrong("not a number"))?;
    if hertz.fract() != 0.0 || !(1.0..=1e6).contains(&hertz) {
        return Err(Refusal::Rate(hertz));
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a whole number in that range")]
    Ok(hertz as u32)
}

/// Each with the next one.
fn pairs<T>(all: &[T]) -> impl Iterator<Item = (&T, &T)> {
    all.iter().zip(all.iter().skip(1))
}

/// Rows are at equal distances: no tick is missing, and none is there twice.
fn check_ticks(frames: &[Frame]) -> Result<(), Refusal> {
    if frames.is_empty() {
        return Err(Refusal::NoFrames);
    }
    match pairs(frames).find(|(one, next)| next.number != one.number.wrapping_add(1)) {
        Some((one, next)) => {
            Err(Refusal::Hole { first: u64::from(one.number) + 1, last: u64::from(next.number).saturating_sub(1) })
        }
        None => Ok(()),
    }
}

/// The slots of all rows, with the samples that the frames name.
fn chosen(modalities: &[Listed], frames: &[Frame], samples: &BTreeMap<ModalityId, Vec<(u32, u64)>>) -> Vec<Slot> {
    // By modality: the places of the samples of a number. A counter that began again has several.
    let by_number: BTreeMap<ModalityId, BTreeMap<u32, Vec<(u32, u64)>>> = samples
        .iter()
        .map(|(id, samples)| {
            let mut places: BTreeMap<u32, Vec<(u32, u64)>> = BTreeMap::new();
            for (place, (number, captured)) in (0..).zip(samples) {
                places.entry(*number).or_default().push((place, *captured));
            }
            (*id, places)
        })
        .collect();
    let slot = |frame: &Frame, modality: &Listed| {
        let found = frame.slots.iter().find(|slot| slot.id == modality.bit)?;
        let FrameSlot { present, plugged, valid, age_ns, seq, .. } = *found;
        #[expect(clippy::cast_possible_truncation, reason = "a message has the lower 32 bits of a number")]
        let named = seq.filter(|_| present).map(|seq| seq as u32);
        let candidates = named.and_then(|number| by_number.get(&modality.bit)?.get(&number));
        let captured = frame.time_ns.saturating_add_signed(age_ns.saturating_neg()).saturating_add(modality.latency_ns);
        let nearest = |(_, time): &&(u32, u64)| time.abs_diff(captured);
        let sample = candidates.and_then(|candidates| candidates.iter().min_by_key(nearest)).map(|(place, _)| *place);
        Some(Slot {
            present,
            plugged,
            valid: valid && sample.is_some(),
            age_ns: if sample.is_some() { age_ns } else { 0 },
            sample,
        })
    };
    frames
        .iter()
        .flat_map(|frame| modalities.iter().map(move |modality| slot(frame, modality).unwrap_or_default()))
        .collect()
}

/// By modality, the form that most of the samples have that rows show; rows whose sample has another are added to `unfit`.
fn forms(
    modalities: &[Listed],
    slots: &[Slot],
    stated: &BTreeMap<ModalityId, Vec<Option<Form>>>,
    unfit: &mut Vec<Unfit>,
) -> Vec<Option<Form>> {
    let form_of = |(at, modality): (usize, &Listed)| {
        let stated = stated.get(&modality.bit).map(Vec::as_slice).unwrap_or_default();
        let samples = slots.iter().skip(at).step_by(modalities.len()).filter_map(|slot| slot.sample);
        let form = |sample: u32| stated.get(usize::try_from(sample).ok()?).copied().flatten();
        let all = || samples.clone().filter_map(form).filter(|form| form.is_of(modality.kind));
        let expected = Form::most_frequent(all(), modality.declared())?;
        let mut others = all().filter(|form| *form != expected).peekable();
        if let Some(other) = others.peek().copied() {
            let reason = format!("{other}, and not {expected}");
            unfit.push(Unfit { name: modality.name.clone(), count: others.count(), reason });
        }
        Some(expected)
    };
    modalities.iter().enumerate().map(form_of).collect()
}

/// Samples that were read and whose row is still to come.
struct Waiting<'a> {
    index: &'a Index,
    /// By modality: how many samples were read, and the last row that needs each of those that are needed.
    read: Vec<u32>,
    last_use: Vec<BTreeMap<u32, usize>>,
    samples: Vec<BTreeMap<u32, Rc<Payload>>>,
    bytes: usize,
    /// The next row.
    row: usize,
    shown: Vec<Option<Rc<Payload>>>,
}

impl<'a> Waiting<'a> {
    fn new(index: &'a Index) -> Self {
        let count = index.modalities.len();
        let mut last_use = vec![BTreeMap::new(); count];
        for row in 0..index.ticks.len() {
            for (uses, slot) in last_use.iter_mut().zip(index.slots(row)) {
                uses.extend(slot.sample.map(|sample| (sample, row)));
            }
        }
        let samples = vec![BTreeMap::new(); count];
        Self { index, read: vec![0; count], last_use, samples, bytes: 0, row: 0, shown: vec![None; count] }
    }

    /// Takes the next sample of a modality; returns whether a row needs it.
    fn push(&mut self, id: ModalityId, sample: &Sample<'_>) -> Result<bool, Refusal> {
        let Some(at) = self.index.modalities.iter().position(|modality| modality.bit == id) else { return Ok(false) };
        let (Some(read), Some(uses), Some(samples)) =
            (self.read.get_mut(at), self.last_use.get(at), self.samples.get_mut(at))
        else {
            return Ok(false);
        };
        let place = *read;
        *read = read.saturating_add(1);
        if !uses.contains_key(&place) {
            return Ok(false);
        }
        let expected = self.index.forms.get(at).copied().flatten();
        let is_fit = expected.is_none() || Form::of_sample(sample) == expected;
        let payload = Payload::from_sample(sample).filter(|_| is_fit).unwrap_or(Payload::Numbers(Vec::new()));
        self.bytes += payload.size();
        samples.insert(place, Rc::new(payload));
        if self.bytes > MOST_WAITING { Err(Refusal::Order) } else { Ok(true) }
    }

    /// Passes on all rows whose samples are there.
    fn flush<E>(&mut self, take: &mut impl FnMut(&Row<'_>) -> Result<(), E>) -> Result<(), E> {
        while let Some(tick) = self.index.ticks.get(self.row) {
            let slots = self.index.slots(self.row);
            for ((shown, samples), slot) in self.shown.iter_mut().zip(&self.samples).zip(slots) {
                *shown = slot.sample.and_then(|sample| samples.get(&sample)).map(Rc::clone);
                if slot.sample.is_some() && shown.is_none() {
                    return Ok(());
                }
            }
            let period_ns = 1_000_000_000 / u64::from(self.index.fps.max(1));
            let action = self.index.actions.at(*tick, period_ns);
            take(&Row { number: self.row, time_ns: *tick, slots, samples: &self.shown, action })?;
            for ((samples, uses), slot) in self.samples.iter_mut().zip(&self.last_use).zip(slots) {
                let done = slot.sample.filter(|sample| uses.get(sample) == Some(&self.row));
                if let Some(payload) = done.and_then(|sample| samples.remove(&sample)) {
                    self.bytes = self.bytes.saturating_sub(payload.size());
                }
            }
            self.row += 1;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn actions(times: &[u64]) -> Actions {
        let values = times.iter().flat_map(|time| [*time as f64, -(*time as f64)]).collect();
        Actions { times: times.to_vec(), values, length: 2 }
    }

    #[test]
    fn the_action_of_a_tick_is_the_nearest_within_half_a_period_or_the_one_in_force() {
        let all = actions(&[100, 140, 200]);
        // A period of 100: half of it is 50.
        for (tick, expected) in
            [(0, 100), (60, 100), (100, 100), (119, 100), (121, 140), (169, 140), (171, 200), (900, 200)]
        {
            assert_eq!(all.at(tick, 100), [f64::from(expected), -f64::from(expected)], "{tick}");
        }
        // The next one is too far away: the last is still in force.
        assert_eq!(actions(&[0, 400]).at(300, 100), [0.0, -0.0]);
        assert_eq!(Actions::default().at(3, 100), [0.0; 0]);
        let mut mixed = actions(&[140, 100]);
        mixed.sort();
        assert_eq!((mixed.at(100, 10), mixed.at(140, 10)), (&[100.0, -100.0][..], &[140.0, -140.0][..]));
    }

    fn frame(number: u32, time_ns: u64, seq: Option<u64>, present: bool) -> Frame {
        let id = ModalityId::new(3).unwrap();
        let slot = FrameSlot { id, present, plugged: number != 2, valid: present, stale: false, age_ns: 10, seq };
        Frame { number, time_ns, slots: vec![slot] }
    }

    fn listed(text: &str) -> Result<Vec<Listed>, Refusal> {
        modalities(Some(text))
    }

    #[test]
    fn a_row_has_the_sample_that_its_frame_names_and_no_other() {
        let modalities =
            listed(r#"[{"name": "b", "bit": 5, "kind": "bytes"}, {"name": "a", "bit": 3, "kind": "scalars"}]"#)
                .unwrap();
        assert_eq!(modalities.iter().map(|modality| &*modality.name).collect::<Vec<_>>(), ["a", "b"]);
        // Number 1 is there twice, because the device began to count again.
        let samples = [(ModalityId::new(3).unwrap(), vec![(1, 90), (2, 190), (1, 390)])].into();
        let frames = [
            frame(0, 100, Some(1), true),
            frame(1, 200, Some(2 + (1 << 32)), true),
            frame(2, 300, Some(2), false),
            frame(3, 400, Some(1), true),
            frame(4, 500, Some(7), true),
            frame(5, 600, None, true),
        ];
        let slots = chosen(&modalities, &frames, &samples);
        let plugged: Vec<bool> = slots.iter().step_by(2).map(|slot| slot.plugged).collect();
        assert_eq!(plugged, [true, true, false, true, true, true]);
        let found: Vec<_> = slots.iter().step_by(2).map(|slot| (slot.present, slot.valid, slot.sample)).collect();
        let there = |sample| (true, true, Some(sample));
        let without = (true, false, None);
        assert_eq!(found, [there(0), there(1), (false, false, None), there(2), without, without]);
        assert!(slots.iter().skip(1).step_by(2).all(|slot| *slot == Slot::default()));
    }

    #[test]
    fn what_makes_rows_unequal_is_refused() {
        let ticks = |numbers: &[u32]| {
            let frames: Vec<Frame> = numbers.iter().map(|number| frame(*number, 0, None, true)).collect();
            check_ticks(&frames).map_err(|refusal| refusal.to_string())
        };
        assert_eq!(ticks(&[7, 8, 9]), Ok(()));
        assert!(ticks(&[]).unwrap_err().starts_with("no frames"));
        assert!(ticks(&[0, 1, 5]).unwrap_err().starts_with("ticks 2 to 4 are missing"));
        assert!(ticks(&[0, 0]).is_err());
        assert_eq!(rate(Some("30")).unwrap(), 30);
        for wrong in [Some("29.97"), Some("0"), Some("-3"), Some("x"), Some("NaN"), None] {
            assert!(rate(wrong).is_err(), "{wrong:?}");
        }
        let twice = r#"[{"name": "a", "bit": 3, "kind": "bytes"}, {"name": "b", "bit": 3, "kind": "bytes"}]"#;
        for wrong in [twice, r#"[{"name": "a/b", "bit": 3, "kind": "bytes"}]"#, "[{}]", "7"] {
            assert!(listed(wrong).is_err(), "{wrong}");
        }
    }
}
