//! The features of a dataset: what all of its episodes have in common, and `info.json` contains.
//!
//! The modalities of `rapid.mask`, `rapid.plugged`, `rapid.valid` and `rapid.age` are those of the registry, ascending by
//! bit, also those whose samples are not exported. A feature whose name begins with `observation.` is an input of a policy in
//! LeRobot; those four are not.

use std::collections::BTreeMap;

use rapid_core::action::ACTION_TOPIC;
use rapid_core::modality::ModalityKind;
use rapid_episode::decode::Kind;
use rapid_registry::ExportSpec;
use rapid_registry::columns::{self, ColumnError, Vector};
use serde_json::{Map, Value, json};

use super::picture::{Codec, Pictures, Shape};
use super::rows::{LONGEST, Refusal, Topic};
use super::statistics::Column;
use super::survey::{Content, Survey};

/// Feature of the vectors.
pub(super) const STATE: &str = "observation.state";
/// Feature of the actions.
pub(super) const ACTION: &str = "action";
/// What the feature of a camera begins with.
pub(super) const IMAGES: &str = "observation.images.";
pub(super) const MASK: &str = "rapid.mask";
pub(super) const PLUGGED: &str = "rapid.plugged";
pub(super) const VALID: &str = "rapid.valid";
pub(super) const AGE: &str = "rapid.age";
pub(super) const TIME: &str = "rapid.time_ns";
/// Of the state and the action: the parts of the choice that they follow from.
const CHOSEN: &str = "chosen";
/// Columns that a message names.
const MOST_NAMED: usize = 8;
/// What every LeRobot dataset has, as 64-bit integers but for the first, which is f32 and seconds.
pub(super) const OWN: [&str; 5] = ["timestamp", "frame_index", "episode_index", "index", "task_index"];

/// Where the numbers of a column come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Origin {
    /// The topic of actions.
    Topic,
    /// A modality, by its place among all.
    Modality(usize),
}

impl Origin {
    /// The modality, if it is one.
    pub(super) const fn modality(self) -> Option<usize> {
        match self {
            Self::Topic => None,
            Self::Modality(place) => Some(place),
        }
    }
}

/// A column of the state or of the action.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Axis {
    pub(super) origin: Origin,
    /// The place of its number in a sample of the modality, or in an action.
    pub(super) at: usize,
    /// Its name in the dataset: that of the modality, a dot and the name or the place of the number; of the topic of
    /// actions the name of the axis alone.
    pub(super) name: String,
}

/// See the module's comment.
#[derive(Debug, Clone, PartialEq)]
pub struct Features {
    pub(super) fps: u32,
    /// All modalities, ascending by bit.
    pub(super) modalities: Vec<String>,
    /// Cameras: their place among the modalities.
    pub(super) cameras: Vec<(usize, Shape)>,
    pub(super) pictures: Pictures,
    pub(super) state: Vec<Axis>,
    pub(super) action: Vec<Axis>,
    /// The choice that they follow from: of an episode whose sensors have other lengths other columns follow from it.
    pub(super) choice: ExportSpec,
}

/// A feature as `info.json` describes it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Feature {
    pub(super) key: String,
    pub(super) dtype: &'static str,
    pub(super) shape: Vec<u32>,
    names: Value,
    /// Further keys. Of the state and the action: where each column comes from, as `NAME.0` or `/action.0`, and what was
    /// chosen. Of a video: as `lerobot.datasets.video_utils.get_video_info` has it.
    further: Vec<(&'static str, Value)>,
}

impl Features {
    /// Those of an episode. What an absent sensor would have sent is known from `known`, an episode of the set that has
    /// it, or from the registry that the episode was recorded with.
    ///
    /// # Errors
    /// When a name chosen is not in the episode, or the shape of a sensor's samples is not known.
    pub fn from_survey(
        episode: &Survey,
        choice: &ExportSpec,
        pictures: Pictures,
        known: &Known,
    ) -> Result<Self, Refusal> {
        let mut features = Self {
            fps: episode.fps,
            modalities: episode.streams.iter().map(|stream| stream.name.clone()).collect(),
            cameras: Vec::new(),
            pictures,
            state: Vec::new(),
            action: Vec::new(),
            choice: choice.clone(),
        };
        let (mut vectors, mut origins) = (Vec::new(), Vec::new());
        for (place, stream) in episode.streams.iter().enumerate() {
            let name = &stream.name;
            match stream.content {
                Content::Camera { found, declared } => {
                    let shape = found.or_else(|| known.shape(name)).or(declared);
                    let mut shape = shape.ok_or_else(|| Refusal::NoSize(name.clone()))?;
                    if let Pictures::Video(_) = pictures {
                        if shape.width % 2 + shape.height % 2 > 0 {
                            return Err(Refusal::OddSize { name: name.clone(), shape: shape.to_string() });
                        }
                        // A video has colours, also of grey pictures.
                        shape.channels = 3;
                    }
                    features.cameras.push((place, shape));
                }
                Content::Vector { found, declared } => {
                    // What a dataset has may be a part of the numbers.
                    let length = found.or_else(|| known.length(name).max(declared));
                    vectors.push(Vector { name: name.clone(), length, names: stream.names.clone() });
                    origins.push(Origin::Modality(place));
                }
                Content::Bytes => {}
            }
        }
        let ExportSpec { state, action } = &mut features.choice;
        if state.is_empty() {
            *state = vectors.iter().map(|vector| vector.name.clone()).collect();
        }
        features.state = axes(state, &vectors, &origins)?;
        if let Some(length) = episode.action_length() {
            vectors.push(Vector {
                name: ACTION_TOPIC.to_owned(),
                length: Some(length),
                names: episode.action_names.clone(),
            });
            origins.push(Origin::Topic);
            if action.is_empty() {
                action.push(ACTION_TOPIC.to_owned());
            }
        } else if action.iter().any(|part| part.split('.').next() == Some(ACTION_TOPIC)) {
            return Err(Refusal::NoActions);
        }
        features.action = axes(action, &vectors, &origins)?;
        Ok(features)
    }

    /// All features, in the order of the table's columns.
    pub(super) fn all(&self) -> Vec<Feature> {
        let feature = |key: &str, dtype, shape: Vec<u32>, names| {
            let key = key.to_owned();
            Feature { key, dtype, shape, names, further: Vec::new() }
        };
        let wide = |length: usize| vec![u32::try_from(length).unwrap_or(u32::MAX)];
        let mut all: Vec<Feature> = self
            .cameras
            .iter()
            .map(|(place, Shape { height, width, channels })| {
                let shape = vec![*height, *width, (*channels).into()];
                let (dtype, further) = match self.pictures {
                    Pictures::Files => ("image", Vec::new()),
                    Pictures::Video(codec) => ("video", vec![("info", self.video_info(codec, *height, *width))]),
                };
                let names = json!(["height", "width", "channels"]);
                Feature { further, ..feature(&self.camera_key(*place), dtype, shape, names) }
            })
            .collect();
        let ExportSpec { state, action } = &self.choice;
        for (key, axes, chosen) in [(STATE, &self.state, state), (ACTION, &self.action, action)] {
            if !axes.is_empty() {
                let names: Vec<&str> = axes.iter().map(|axis| axis.name.as_str()).collect();
                let columns: Vec<String> = axes.iter().map(|axis| self.column(axis)).collect();
                let further = vec![("columns", json!(columns)), (CHOSEN, json!(chosen))];
                all.push(Feature { further, ..feature(key, "float32", wide(axes.len()), json!(names)) });
            }
        }
        for (key, dtype) in [(MASK, "float32"), (PLUGGED, "float32"), (VALID, "float32"), (AGE, "float64")] {
            all.push(feature(key, dtype, wide(self.modalities.len()), json!(self.modalities)));
        }
        all.push(feature(TIME, "int64", vec![1], Value::Null));
        for key in OWN {
            all.push(feature(key, if key == "timestamp" { "float32" } else { "int64" }, vec![1], Value::Null));
        }
        all
    }

    /// Where a column comes from.
    fn column(&self, axis: &Axis) -> String {
        let origin = match axis.origin {
            Origin::Topic => ACTION_TOPIC,
            Origin::Modality(place) => self.modalities.get(place).map_or("", String::as_str),
        };
        format!("{origin}.{}", axis.at)
    }

    /// The feature of a camera.
    pub(super) fn camera_key(&self, place: usize) -> String {
        format!("{IMAGES}{}", self.modalities.get(place).map_or("", String::as_str))
    }

    /// The features whose pictures are in videos, in the order of the cameras.
    pub(super) fn videos(&self) -> impl Iterator<Item = (String, Shape)> {
        let cameras = if self.pictures == Pictures::Files { &[] } else { &*self.cameras };
        cameras.iter().map(|(place, shape)| (self.camera_key(*place), *shape))
    }

    /// How many videos an episode has.
    pub fn videos_per_episode(&self) -> usize {
        self.videos().count()
    }

    /// How the dataset has its pictures.
    pub fn pictures(&self) -> Pictures {
        self.pictures
    }

    fn video_info(&self, codec: Codec, height: u32, width: u32) -> Value {
        json!({
            "video.height": height, "video.width": width, "video.codec": codec.name(), "video.pix_fmt": "yuv420p",
            "video.is_depth_map": false, "video.fps": self.fps, "video.channels": 3, "has_audio": false,
        })
    }

    /// The value of `features` in `info.json`.
    pub(super) fn json(&self) -> Value {
        let of = |feature: Feature| {
            let Feature { key, dtype, shape, names, further } = feature;
            let mut value = json!({ "dtype": dtype, "shape": shape, "names": names });
            for (key, further) in further {
                value[key] = further;
            }
            (key, value)
        };
        Value::Object(self.all().into_iter().map(of).collect())
    }

    /// Those of a dataset, from its `info.json`; `None` if it is not one that this module describes.
    pub(super) fn of_set(info: &Value) -> Option<Self> {
        let features = info.get("features")?.as_object()?;
        let texts = |key: &str, of: &str| -> Option<Vec<String>> {
            let texts = features.get(key)?.get(of)?.as_array()?;
            texts.iter().map(|text| text.as_str().map(str::to_owned)).collect()
        };
        let modalities = texts(MASK, "names")?;
        let place = |name: &str| modalities.iter().position(|modality| modality == name);
        let mut cameras = Vec::new();
        let mut pictures = Pictures::Files;
        for (at, modality) in modalities.iter().enumerate() {
            let Some(feature) = features.get(&format!("{IMAGES}{modality}")) else { continue };
            let side = |axis: usize| feature.get("shape")?.get(axis)?.as_u64();
            let (height, width) = (u32::try_from(side(0)?).ok()?, u32::try_from(side(1)?).ok()?);
            cameras.push((at, Shape::new(height, width, u8::try_from(side(2)?).ok()?)?));
            if let Some(info) = feature.get("info") {
                let codec = info.get("video.codec")?.as_str()?;
                pictures = Pictures::Video(Codec::ALL.into_iter().find(|known| known.name() == codec)?);
            }
        }
        let read = |(name, column): (String, String)| {
            let (origin, at) = column.rsplit_once('.')?;
            let origin = if origin == ACTION_TOPIC { Origin::Topic } else { Origin::Modality(place(origin)?) };
            // A longer vector is in no episode.
            let at = at.parse().ok().filter(|at| *at < LONGEST)?;
            Some(Axis { origin, at, name })
        };
        let read_all = |key: &str| -> Option<Vec<Axis>> {
            if !features.contains_key(key) {
                return Some(Vec::new());
            }
            texts(key, "names")?.into_iter().zip(texts(key, "columns")?).map(read).collect()
        };
        let (state, action) = (read_all(STATE)?, read_all(ACTION)?);
        let choice = ExportSpec {
            state: texts(STATE, CHOSEN).unwrap_or_default(),
            action: texts(ACTION, CHOSEN).unwrap_or_default(),
        };
        let fps = u32::try_from(info.get("fps")?.as_u64()?).ok()?;
        let found = Self { fps, modalities, cameras, pictures, state, action, choice };
        (found.json() == Value::Object(features.clone())).then_some(found)
    }

    /// The choice that leads to these features.
    pub fn choice(&self) -> &ExportSpec {
        &self.choice
    }

    /// Why an episode with the features `other` does not belong to a set with these.
    ///
    /// # Errors
    /// The first difference.
    pub fn check(&self, other: &Self) -> Result<(), Refusal> {
        if self.fps != other.fps {
            let (found, expected) = (other.fps, self.fps);
            return Err(Refusal::Different(format!("{found} frames a second, and {expected} in the dataset")));
        }
        let compared = |features: &Self| match features.json() {
            Value::Object(mut features) => {
                // Several choices lead to the same columns.
                features.values_mut().filter_map(Value::as_object_mut).for_each(|feature| drop(feature.remove(CHOSEN)));
                features
            }
            _ => Map::new(),
        };
        let (mine, theirs) = (&compared(self), &compared(other));
        let described = |features: &Map<String, Value>, key: &str| match features.get(key) {
            None => "absent".to_owned(),
            Some(feature) => format!("{} {}", feature["shape"], feature["names"]),
        };
        match mine.keys().chain(theirs.keys()).find(|key| mine.get(*key) != theirs.get(*key)) {
            None => Ok(()),
            Some(key) => {
                let (found, expected) = (described(theirs, key), described(mine, key));
                Err(Refusal::Different(format!("{key} is {found}, and {expected} in the dataset")))
            }
        }
    }

    /// The statistics of an episode, by feature: of a picture a column for each channel.
    pub(super) fn statistics(&self, episode: &Survey) -> Vec<(String, Vec<Column>)> {
        let stream = |place: usize| episode.streams.get(place);
        // Of a modality without a usable sample the columns have no rows.
        let axes = |axes: &[Axis]| {
            let column = |axis: &Axis| {
                let columns = match axis.origin {
                    Origin::Topic => episode.action.as_ref(),
                    Origin::Modality(place) => stream(place).map(|stream| &stream.columns),
                };
                columns.and_then(|columns| columns.get(axis.at)).copied().unwrap_or_default()
            };
            axes.iter().map(column).collect()
        };
        // In a video a grey picture has three equal channels.
        let channels = |place: usize, count: usize| {
            let found = stream(place).map(|stream| stream.columns.as_slice()).unwrap_or_default();
            if let [grey] = found {
                return vec![*grey; count];
            }
            let mut columns = found.to_vec();
            columns.resize(count, Column::default());
            columns
        };
        let of = |key: &str| match key {
            STATE => axes(&self.state),
            ACTION => axes(&self.action),
            MASK => episode.streams.iter().map(|stream| stream.present).collect(),
            PLUGGED => episode.streams.iter().map(|stream| stream.plugged).collect(),
            VALID => episode.streams.iter().map(|stream| stream.valid).collect(),
            AGE => episode.streams.iter().map(|stream| stream.age).collect(),
            TIME => vec![episode.time_ns],
            key => {
                let camera = self.cameras.iter().find(|(place, _)| {
                    key.strip_prefix(IMAGES).is_some_and(|name| self.modalities.get(*place).is_some_and(|m| m == name))
                });
                camera.map(|(place, shape)| channels(*place, shape.channels.into())).unwrap_or_default()
            }
        };
        let keys = self.all().into_iter().map(|feature| feature.key).filter(|key| !OWN.contains(&key.as_str()));
        keys.map(|key| (key.clone(), of(&key))).collect()
    }
}

/// Something that an episode has and the dataset does not.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
pub struct NotExported {
    /// The sensor, or the topic.
    pub name: String,
    /// Why.
    pub reason: String,
}

impl Features {
    /// What of an episode the dataset does not have: sensors and topics with messages, and numbers. The mask has its
    /// features, and a frame is a row.
    pub fn not_exported(&self, episode: &Survey) -> Vec<NotExported> {
        let of_topic = |topic: &Topic| {
            let place = topic.bit.and_then(|bit| episode.bits.iter().position(|other| *other == bit));
            let (name, reason) = match (place, topic.kind) {
                (Some(place), _) => (self.modalities.get(place)?.clone(), self.lacks(episode, place)?),
                (None, _) if topic.name == ACTION_TOPIC => {
                    let length = episode.action_length().unwrap_or_default();
                    (topic.name.clone(), self.not_chosen(Origin::Topic, length, &episode.action_names)?)
                }
                (None, Kind::Mask | Kind::Frame) => return None,
                (None, Kind::Event | Kind::Other | Kind::Sample(_)) => {
                    (topic.name.clone(), "neither samples of a sensor nor actions".to_owned())
                }
            };
            Some(NotExported { name, reason })
        };
        let mut found: Vec<NotExported> = episode.topics.iter().filter_map(of_topic).collect();
        found.sort();
        // A sensor has several topics if it sends what its registry did not announce.
        found.dedup();
        found
    }

    /// Why a modality is not in the dataset, or not all of it.
    fn lacks(&self, episode: &Survey, place: usize) -> Option<String> {
        match (episode.kinds.get(place)?, episode.streams.get(place)?) {
            (ModalityKind::Depth, _) => Some("depth, for which LeRobot has no feature".to_owned()),
            (ModalityKind::Bytes, _) => Some("bytes, for which LeRobot has no feature".to_owned()),
            (ModalityKind::Image, _) => None,
            (ModalityKind::Scalars, stream) => {
                let Content::Vector { found, .. } = stream.content else { return None };
                self.not_chosen(Origin::Modality(place), found?, &stream.names)
            }
        }
    }

    /// Which of so many numbers are in no column.
    fn not_chosen(&self, origin: Origin, length: usize, names: &[String]) -> Option<String> {
        let is_chosen =
            |at: usize| self.state.iter().chain(&self.action).any(|axis| axis.origin == origin && axis.at == at);
        let left: Vec<usize> = (0..length).filter(|at| !is_chosen(*at)).collect();
        let choice = "--state, --action or [export]";
        if left.is_empty() {
            return None;
        }
        if left.len() == length {
            return Some(format!("not chosen by {choice}"));
        }
        let name = |at: &usize| names.get(*at).cloned().unwrap_or_else(|| at.to_string());
        let shown: Vec<String> = left.iter().take(MOST_NAMED).map(name).collect();
        let more =
            if left.len() > MOST_NAMED { format!(" and {} more", left.len() - MOST_NAMED) } else { String::new() };
        Some(format!("columns {}{more} are not chosen by {choice}", shown.join(", ")))
    }
}

/// The columns that `parts` name.
fn axes(parts: &[String], vectors: &[Vector], origins: &[Origin]) -> Result<Vec<Axis>, Refusal> {
    let axis = |(place, at): (usize, usize)| {
        let (vector, origin) = (vectors.get(place)?, *origins.get(place)?);
        let name = match (vector.named().and_then(|names| names.get(at)), origin) {
            (Some(name), Origin::Topic) => name.clone(),
            (None, Origin::Topic) => format!("{ACTION}.{at}"),
            (Some(name), Origin::Modality(_)) => format!("{}.{name}", vector.name),
            (None, Origin::Modality(_)) => format!("{}.{at}", vector.name),
        };
        Some(Axis { origin, at, name })
    };
    let chosen = columns::choose(parts, vectors).map_err(|error| match error {
        ColumnError::NoLength(name) => Refusal::NoSize(name),
        error => error.into(),
    })?;
    Ok(chosen.into_iter().filter_map(axis).collect())
}

/// Shapes of samples, from episodes that have them.
#[derive(Debug, Clone, Default)]
pub struct Known(Vec<(String, Content)>);

impl Known {
    /// Learns what is in an episode.
    pub fn learn(&mut self, episode: &Survey) {
        for stream in &episode.streams {
            let is_new = self.0.iter().all(|(name, _)| *name != stream.name);
            let is_there = matches!(
                stream.content,
                Content::Camera { found: Some(_), .. } | Content::Vector { found: Some(_), .. }
            );
            if is_new && is_there {
                self.0.push((stream.name.clone(), stream.content));
            }
        }
    }

    /// What a dataset has. Of a vector the columns up to the last that it has.
    pub fn from_features(features: &Features) -> Self {
        let name = |place: usize| features.modalities.get(place).cloned().unwrap_or_default();
        let camera =
            |(place, shape): &(usize, Shape)| (name(*place), Content::Camera { found: Some(*shape), declared: None });
        let mut lengths: BTreeMap<usize, usize> = BTreeMap::new();
        for axis in features.state.iter().chain(&features.action) {
            if let Some(place) = axis.origin.modality() {
                let length = lengths.entry(place).or_default();
                *length = axis.at.saturating_add(1).max(*length);
            }
        }
        let vectors = lengths
            .into_iter()
            .map(|(place, length)| (name(place), Content::Vector { found: Some(length), declared: None }));
        Self(features.cameras.iter().map(camera).chain(vectors).collect())
    }

    fn shape(&self, name: &str) -> Option<Shape> {
        self.0.iter().find_map(|(known, content)| match content {
            Content::Camera { found, .. } if known == name => *found,
            _ => None,
        })
    }

    fn length(&self, name: &str) -> Option<usize> {
        self.0.iter().find_map(|(known, content)| match content {
            Content::Vector { found, .. } if known == name => *found,
            _ => None,
        })
    }
}

#[cfg(test)]
mod tests {
    use rapid_status::Grade;
    use rapid_status::session::Notes;

    use super::super::survey::Stream;
    use super::*;

    fn features() -> Features {
        Features {
            fps: 30,
            modalities: ["cam", "arm", "force", "raw"].map(str::to_owned).into(),
            cameras: vec![(0, Shape { height: 480, width: 640, channels: 3 })],
            pictures: Pictures::Files,
            state: vec![axis(2, 0, "force.0"), axis(1, 1, "arm.y"), axis(1, 0, "arm.x")],
            action: ["x", "grip"].into_iter().enumerate().map(|(at, name)| topic(at, name)).collect(),
            choice: choice(&["force", "arm.1", "arm.0"], &["/action"]),
        }
    }

    fn choice(state: &[&str], action: &[&str]) -> ExportSpec {
        let texts = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect();
        ExportSpec { state: texts(state), action: texts(action) }
    }

    fn axis(place: usize, at: usize, name: &str) -> Axis {
        Axis { origin: Origin::Modality(place), at, name: name.to_owned() }
    }

    fn topic(at: usize, name: &str) -> Axis {
        Axis { origin: Origin::Topic, at, name: name.to_owned() }
    }

    #[test]
    fn features_are_read_back_from_what_is_written() {
        let both = vec![axis(1, 7, "arm.grip"), topic(1, "y")];
        let sent = vec![topic(0, "action.0")];
        let both = (both, vec!["arm.7", "/action.y"]);
        for (action, chosen) in [(Vec::new(), Vec::new()), (sent, vec!["/action"]), both] {
            let chosen = chosen.as_slice();
            let features = Features { action, choice: choice(&["force", "arm.1", "arm.0"], chosen), ..features() };
            let info = json!({ "fps": 30, "features": features.json() });
            assert_eq!(Features::of_set(&info), Some(features));
        }
        for codec in Codec::ALL {
            let features = Features { pictures: Pictures::Video(codec), ..features() };
            let info = json!({ "fps": 30, "features": features.json() });
            assert_eq!(Features::of_set(&info), Some(features));
        }
        let mut info = json!({ "fps": 30, "features": features().json() });
        info["features"]["observation.state"]["shape"] = json!([5]);
        assert_eq!(Features::of_set(&info), None, "of another program");
    }

    fn episode(contents: &[(&str, Content)]) -> Survey {
        let stream = |(name, content): &(&str, Content)| Stream {
            name: (*name).to_owned(),
            content: *content,
            names: Vec::new(),
            columns: Vec::new(),
            present: Column::default(),
            plugged: Column::default(),
            valid: Column::default(),
            age: Column::default(),
        };
        Survey {
            file: "a.mcap".into(),
            bytes: 0,
            sha256: String::new(),
            grade: Grade::Good,
            noted: Notes::default(),
            rows: 1,
            unusable: 0,
            unfit: Vec::new(),
            fps: 30,
            task: String::new(),
            export: ExportSpec::default(),
            unread_registry: None,
            action_names: Vec::new(),
            streams: contents.iter().map(stream).collect(),
            action: None,
            time_ns: Column::default(),
            kinds: Vec::new(),
            bits: Vec::new(),
            topics: Vec::new(),
        }
    }

    #[test]
    fn the_shape_of_what_is_absent_comes_from_the_set_before_the_registry() {
        let shape = |height| Shape::new(height, 640, 3);
        let camera = |found, declared| ("cam", Content::Camera { found, declared });
        let arm = ("arm", Content::Vector { found: Some(3), declared: None });
        let of = |content, known: &Known| {
            Features::from_survey(&episode(&[content, arm]), &ExportSpec::default(), Pictures::Files, known)
        };
        let height = |found: Result<Features, Refusal>| found.map(|features| features.cameras[0].1.height);
        let mut known = Known::default();
        assert_eq!(height(of(camera(shape(480), shape(240)), &known)).unwrap(), 480);
        assert_eq!(height(of(camera(None, shape(240)), &known)).unwrap(), 240);
        let refused = height(of(camera(None, None), &known)).unwrap_err().to_string();
        assert!(refused.starts_with("cam: no usable sample to take the size from"), "{refused}");
        known.learn(&episode(&[camera(shape(720), None), arm]));
        assert_eq!(height(of(camera(None, shape(240)), &known)).unwrap(), 720);
        assert_eq!(Known::from_features(&features()).length("arm"), Some(2));
    }

    #[test]
    fn columns_are_chosen_by_name_and_in_that_order() {
        let vector = |name, length| (name, Content::Vector { found: Some(length), declared: None });
        let mut episode = episode(&[vector("arm", 3), ("raw", Content::Bytes), vector("force", 1)]);
        episode.streams[0].names = ["hip.position", "hip.velocity", "tip.x"].map(str::to_owned).into();
        let texts = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>();
        let of = |episode: &Survey, state: &[&str], action: &[&str]| {
            let found = Features::from_survey(episode, &choice(state, action), Pictures::Files, &Known::default());
            found.map_err(|refusal| refusal.to_string())
        };
        let arm = [axis(0, 0, "arm.hip.position"), axis(0, 1, "arm.hip.velocity"), axis(0, 2, "arm.tip.x")];
        let whole = of(&episode, &[], &[]).unwrap();
        assert_eq!((&whole.state[..3], &whole.state[3..]), (&arm[..], &[axis(2, 0, "force.0")][..]));
        assert_eq!((whole.action.len(), &whole.choice), (0, &choice(&["arm", "force"], &[])));
        let joined = of(&episode, &["force", "arm.position"], &["arm.tip", "arm.0"]).unwrap();
        assert_eq!(joined.state, [axis(2, 0, "force.0"), arm[0].clone()]);
        assert_eq!(joined.action, [arm[2].clone(), arm[0].clone()]);
        assert_eq!(of(&episode, &["raw"], &[]).unwrap_err(), "\"raw\" is not a numeric sensor; those are arm, force");
        for chosen in ["/action", "/action.0"] {
            let refused = of(&episode, &[], &["arm", chosen]).unwrap_err();
            assert!(refused.starts_with("no action was sent in this episode"), "{refused}");
        }
        assert!(
            of(&episode, &["arm.3"], &[]).unwrap_err().contains("arm has no column \"3\"; it has 0-2: hip.position")
        );
        assert_eq!(of(&episode, &["arm", "arm.1"], &[]).unwrap_err(), "\"arm.1\" is chosen twice");
        // Actions have the names of their channel, and are not states.
        episode.action = Some(vec![Column::default(); 2]);
        assert_eq!(of(&episode, &[], &[]).unwrap().action, [topic(0, "action.0"), topic(1, "action.1")]);
        episode.action_names = texts(&["x", "grip"]);
        let chosen = of(&episode, &[], &["/action.grip", "force"]).unwrap().action;
        assert_eq!(chosen, [topic(1, "grip"), axis(2, 0, "force.0")]);
        assert!(of(&episode, &["/action"], &[]).unwrap_err().contains("those are arm, force"));
    }

    #[test]
    fn a_choice_is_that_of_the_user_then_that_of_another_by_feature() {
        assert_eq!(choice(&["a"], &[]).or(&choice(&["b"], &["c"])), choice(&["a"], &["c"]));
        assert_eq!(choice(&[], &[]).or(&choice(&[], &[])), ExportSpec::default());
    }

    #[test]
    fn a_difference_is_named() {
        let refused = |other: &Features| features().check(other).unwrap_err().to_string();
        assert!(features().check(&features()).is_ok());
        let otherwise = choice(&["force.0", "arm.1", "arm.0"], &["/action.0-1"]);
        assert!(features().check(&Features { choice: otherwise, ..features() }).is_ok());
        assert_eq!(refused(&Features { fps: 20, ..features() }), "20 frames a second, and 30 in the dataset");
        let mut wide = features();
        wide.cameras[0].1.width = 1280;
        let text = refused(&wide);
        assert!(text.starts_with("observation.images.cam is [480,1280,3]") && text.contains("[480,640,3]"), "{text}");
        let text = refused(&Features { action: Vec::new(), ..features() });
        assert!(text.starts_with("action is absent, and [2]"), "{text}");
    }
}
