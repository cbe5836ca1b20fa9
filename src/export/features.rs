//! The features of a data set: what all of its episodes have in common, and `info.json` contains.
//!
//! The modalities of `rapid.mask`, `rapid.valid` and `rapid.age` are those of the registry, ascending by bit, also those
//! whose samples are not exported. A feature whose name begins with `observation.` is an input of a policy in LeRobot;
//! those three are none.

use std::collections::BTreeSet;

use serde_json::{Map, Value, json};

use super::picture::{Codec, Pictures, Shape};
use super::rows::Refusal;
use super::statistics::Column;
use super::survey::{Content, Survey};

/// Feature of the vectors.
pub(super) const STATE: &str = "observation.state";
/// Feature of the actions.
pub(super) const ACTION: &str = "action";
/// What the feature of a camera begins with.
pub(super) const IMAGES: &str = "observation.images.";
pub(super) const MASK: &str = "rapid.mask";
pub(super) const VALID: &str = "rapid.valid";
pub(super) const AGE: &str = "rapid.age";
pub(super) const TIME: &str = "rapid.time_ns";
/// What every data set of LeRobot has, as 64-bit integers but for the first, which is f32 and seconds.
pub(super) const OWN: [&str; 5] = ["timestamp", "frame_index", "episode_index", "index", "task_index"];

/// Which columns the user chose.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Choice {
    /// Modalities of [`STATE`], in this order; all vectors without a choice.
    pub state: Vec<String>,
    /// The modality of [`ACTION`]; without one the topic `/action`.
    pub action: Option<String>,
    /// How the data set has its pictures.
    pub pictures: Pictures,
}

/// A name that an episode has nothing for.
#[derive(Debug, thiserror::Error)]
pub enum ChoiceError {
    /// It is no modality that consists of numbers.
    #[error("{name:?} is no sensor of numbers; of this episode they are {}", if known.is_empty() { "none" } else { known })]
    Unknown {
        /// The name.
        name: String,
        /// The names that can be chosen.
        known: String,
    },
    /// It is named twice.
    #[error("{0:?} is chosen twice")]
    Twice(String),
}

/// Where the actions come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Actions {
    Absent,
    /// The topic of actions, and its axes.
    Topic(usize),
    /// A modality, by its place among all, and its length.
    Modality(usize, usize),
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
    /// The vectors of the state: place and length.
    pub(super) state: Vec<(usize, usize)>,
    pub(super) actions: Actions,
}

/// A feature as `info.json` describes it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Feature {
    pub(super) key: String,
    pub(super) dtype: &'static str,
    pub(super) shape: Vec<u32>,
    names: Value,
    /// Of a video: as `lerobot.datasets.video_utils.get_video_info` has it.
    info: Option<Value>,
}

impl Features {
    /// Those of an episode. What an absent sensor would have sent is known from `known`, an episode of the set that has
    /// it, or from the registry that the episode was recorded with.
    ///
    /// # Errors
    /// When a name chosen is not in the episode, or the shape of a sensor's samples is not known.
    pub fn of(episode: &Survey, choice: &Choice, known: &Known) -> Result<Self, Refusal> {
        let mut features = Self {
            fps: episode.fps,
            modalities: episode.streams.iter().map(|stream| stream.name.clone()).collect(),
            cameras: Vec::new(),
            pictures: choice.pictures,
            state: Vec::new(),
            actions: Actions::Absent,
        };
        let mut vectors = Vec::new();
        for (place, stream) in episode.streams.iter().enumerate() {
            let name = &stream.name;
            match stream.content {
                Content::Camera { found, declared } => {
                    let shape = found.or_else(|| known.shape(name)).or(declared);
                    let mut shape = shape.ok_or_else(|| Refusal::NoSize(name.clone()))?;
                    if let Pictures::Video(_) = choice.pictures {
                        if shape.width % 2 + shape.height % 2 > 0 {
                            return Err(Refusal::OddSize { name: name.clone(), shape: shape.to_string() });
                        }
                        // A video has colours, also of grey pictures.
                        shape.channels = 3;
                    }
                    features.cameras.push((place, shape));
                }
                Content::Vector { found, declared } => {
                    let length = found.or_else(|| known.length(name)).or(declared);
                    vectors.push((place, name, length));
                }
                Content::Bytes => {}
            }
        }
        let named = |name: &String| {
            let found = vectors.iter().find(|(_, known, _)| *known == name);
            let known = || vectors.iter().map(|(_, name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
            let (place, _, length) =
                found.ok_or_else(|| ChoiceError::Unknown { name: name.clone(), known: known() })?;
            Ok::<_, Refusal>((*place, length.ok_or_else(|| Refusal::NoSize(name.clone()))?))
        };
        features.actions = match (&choice.action, episode.action_length()) {
            (Some(name), _) => named(name).map(|(place, length)| Actions::Modality(place, length))?,
            (None, Some(length)) => Actions::Topic(length),
            (None, None) => Actions::Absent,
        };
        let mut seen = BTreeSet::new();
        if let Some(twice) = choice.state.iter().find(|name| !seen.insert(*name)) {
            return Err(ChoiceError::Twice(twice.clone()).into());
        }
        let all: Vec<String> = vectors.iter().map(|(_, name, _)| (*name).clone()).collect();
        let chosen = if choice.state.is_empty() { &all } else { &choice.state };
        features.state = chosen.iter().map(named).collect::<Result<_, _>>()?;
        Ok(features)
    }

    /// All features, in the order of the table's columns.
    pub(super) fn all(&self) -> Vec<Feature> {
        let feature = |key: &str, dtype, shape: Vec<u32>, names| {
            let key = key.to_owned();
            Feature { key, dtype, shape, names, info: None }
        };
        let wide = |length: usize| vec![u32::try_from(length).unwrap_or(u32::MAX)];
        let name = |place: usize| self.modalities.get(place).map_or("", String::as_str);
        let numbered = |place, length| (0..length).map(move |at| format!("{}.{at}", name(place)));
        let mut all: Vec<Feature> = self
            .cameras
            .iter()
            .map(|(place, Shape { height, width, channels })| {
                let shape = vec![*height, *width, (*channels).into()];
                let (dtype, info) = match self.pictures {
                    Pictures::Files => ("image", None),
                    Pictures::Video(codec) => ("video", Some(self.video_info(codec, *height, *width))),
                };
                let names = json!(["height", "width", "channels"]);
                Feature { info, ..feature(&self.camera_key(*place), dtype, shape, names) }
            })
            .collect();
        let state: Vec<String> = self.state.iter().flat_map(|(place, length)| numbered(*place, *length)).collect();
        if !state.is_empty() {
            all.push(feature(STATE, "float32", wide(state.len()), json!(state)));
        }
        match self.actions {
            Actions::Absent => {}
            Actions::Topic(length) => {
                let axes: Vec<String> = (0..length).map(|axis| axis.to_string()).collect();
                all.push(feature(ACTION, "float32", wide(length), json!(axes)));
            }
            Actions::Modality(place, length) => {
                let columns: Vec<String> = numbered(place, length).collect();
                all.push(feature(ACTION, "float32", wide(length), json!(columns)));
            }
        }
        for (key, dtype) in [(MASK, "float32"), (VALID, "float32"), (AGE, "float64")] {
            all.push(feature(key, dtype, wide(self.modalities.len()), json!(self.modalities)));
        }
        all.push(feature(TIME, "int64", vec![1], Value::Null));
        for key in OWN {
            all.push(feature(key, if key == "timestamp" { "float32" } else { "int64" }, vec![1], Value::Null));
        }
        all
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

    /// How the data set has its pictures.
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
            let Feature { key, dtype, shape, names, info } = feature;
            let mut value = json!({ "dtype": dtype, "shape": shape, "names": names });
            if let Some(info) = info {
                value["info"] = info;
            }
            (key, value)
        };
        Value::Object(self.all().into_iter().map(of).collect())
    }

    /// Those of a data set, from its `info.json`; `None` if it is not one that this module describes.
    pub(super) fn of_set(info: &Value) -> Option<Self> {
        let features = info.get("features")?.as_object()?;
        let names = |key: &str| -> Option<Vec<String>> {
            let names = features.get(key)?.get("names")?.as_array()?;
            names.iter().map(|name| name.as_str().map(str::to_owned)).collect()
        };
        let modalities = names(MASK)?;
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
        let mut state: Vec<(usize, usize)> = Vec::new();
        for name in names(STATE).unwrap_or_default() {
            let at = place(name.rsplit_once('.')?.0)?;
            match state.last_mut() {
                Some((last, length)) if *last == at => *length += 1,
                _ => state.push((at, 1)),
            }
        }
        let actions = match names(ACTION).as_deref() {
            None | Some([]) => Actions::Absent,
            Some([first, rest @ ..]) => match first.rsplit_once('.') {
                Some((modality, _)) => Actions::Modality(place(modality)?, rest.len() + 1),
                None => Actions::Topic(rest.len() + 1),
            },
        };
        let fps = u32::try_from(info.get("fps")?.as_u64()?).ok()?;
        let found = Self { fps, modalities, cameras, pictures, state, actions };
        (found.json() == Value::Object(features.clone())).then_some(found)
    }

    /// The choice that leads to these features.
    pub fn choice(&self) -> Choice {
        let name = |place: usize| self.modalities.get(place).cloned().unwrap_or_default();
        let action = match self.actions {
            Actions::Modality(place, _) => Some(name(place)),
            Actions::Absent | Actions::Topic(_) => None,
        };
        let state = self.state.iter().map(|(place, _)| name(*place)).collect();
        Choice { state, action, pictures: self.pictures }
    }

    /// Why an episode with the features `other` does not belong to a set with these.
    ///
    /// # Errors
    /// The first difference.
    pub fn check(&self, other: &Self) -> Result<(), Refusal> {
        if self.fps != other.fps {
            let (found, expected) = (other.fps, self.fps);
            return Err(Refusal::Different(format!("{found} frames a second, and {expected} in the data set")));
        }
        let (mine, theirs) = (self.json(), other.json());
        let (Value::Object(mine), Value::Object(theirs)) = (&mine, &theirs) else { return Ok(()) };
        let described = |features: &Map<String, Value>, key: &str| match features.get(key) {
            None => "absent".to_owned(),
            Some(feature) => format!("{} {}", feature["shape"], feature["names"]),
        };
        match mine.keys().chain(theirs.keys()).find(|key| mine.get(*key) != theirs.get(*key)) {
            None => Ok(()),
            Some(key) => {
                let (found, expected) = (described(theirs, key), described(mine, key));
                Err(Refusal::Different(format!("{key} is {found}, and {expected} in the data set")))
            }
        }
    }

    /// The statistics of an episode, by feature: of a picture a column for each channel.
    pub(super) fn statistics(&self, episode: &Survey) -> Vec<(String, Vec<Column>)> {
        let stream = |place: usize| episode.streams.get(place);
        // Of a modality without a usable sample the columns have no rows.
        let columns = |place: usize, length: usize| {
            let mut columns = stream(place).map(|stream| stream.columns.clone()).unwrap_or_default();
            columns.resize(length, Column::default());
            columns
        };
        // In a video a grey picture has three equal channels.
        let channels = |place: usize, count: usize| {
            let found = stream(place).map(|stream| stream.columns.as_slice()).unwrap_or_default();
            if let [grey] = found { vec![*grey; count] } else { columns(place, count) }
        };
        let of = |key: &str| match key {
            STATE => self.state.iter().flat_map(|(place, length)| columns(*place, *length)).collect(),
            ACTION => match self.actions {
                Actions::Absent => Vec::new(),
                Actions::Topic(_) => episode.action.clone().unwrap_or_default(),
                Actions::Modality(place, length) => columns(place, length),
            },
            MASK => episode.streams.iter().map(|stream| stream.present).collect(),
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

    /// What a data set has.
    pub fn of(features: &Features) -> Self {
        let name = |place: usize| features.modalities.get(place).cloned().unwrap_or_default();
        let camera =
            |(place, shape): &(usize, Shape)| (name(*place), Content::Camera { found: Some(*shape), declared: None });
        let vector =
            |(place, length): &(usize, usize)| (name(*place), Content::Vector { found: Some(*length), declared: None });
        let action = match features.actions {
            Actions::Modality(place, length) => Some((place, length)),
            Actions::Absent | Actions::Topic(_) => None,
        };
        let vectors = features.state.iter().chain(&action).map(vector);
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
    use super::super::survey::Stream;
    use super::*;
    use crate::status::Grade;

    fn features() -> Features {
        Features {
            fps: 30,
            modalities: ["cam", "arm", "force", "raw"].map(str::to_owned).into(),
            cameras: vec![(0, Shape { height: 480, width: 640, channels: 3 })],
            pictures: Pictures::Files,
            state: vec![(2, 1), (1, 3)],
            actions: Actions::Topic(2),
        }
    }

    #[test]
    fn features_are_read_back_from_what_is_written() {
        for actions in [Actions::Absent, Actions::Topic(2), Actions::Modality(1, 3)] {
            let features = Features { actions, ..features() };
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
        assert_eq!(
            features().choice(),
            Choice { state: vec!["force".to_owned(), "arm".to_owned()], ..Choice::default() }
        );
    }

    fn episode(contents: &[(&str, Content)]) -> Survey {
        let stream = |(name, content): &(&str, Content)| Stream {
            name: (*name).to_owned(),
            content: *content,
            columns: Vec::new(),
            present: Column::default(),
            valid: Column::default(),
            age: Column::default(),
        };
        Survey {
            file: "a.mcap".into(),
            bytes: 0,
            sha256: String::new(),
            grade: Grade::Good,
            rows: 1,
            unusable: 0,
            fps: 30,
            task: String::new(),
            streams: contents.iter().map(stream).collect(),
            action: None,
            time_ns: Column::default(),
            kinds: Vec::new(),
        }
    }

    #[test]
    fn the_shape_of_what_is_absent_comes_from_the_set_before_the_registry() {
        let shape = |height| Shape::new(height, 640, 3);
        let camera = |found, declared| ("cam", Content::Camera { found, declared });
        let arm = ("arm", Content::Vector { found: Some(3), declared: None });
        let of = |content, known: &Known| Features::of(&episode(&[content, arm]), &Choice::default(), known);
        let height = |found: Result<Features, Refusal>| found.map(|features| features.cameras[0].1.height);
        let mut known = Known::default();
        assert_eq!(height(of(camera(shape(480), shape(240)), &known)).unwrap(), 480);
        assert_eq!(height(of(camera(None, shape(240)), &known)).unwrap(), 240);
        let refused = height(of(camera(None, None), &known)).unwrap_err().to_string();
        assert!(refused.starts_with("cam: no usable sample to know the size of"), "{refused}");
        known.learn(&episode(&[camera(shape(720), None), arm]));
        assert_eq!(height(of(camera(None, shape(240)), &known)).unwrap(), 720);
        assert_eq!(Known::of(&features()).length("arm"), Some(3));
    }

    #[test]
    fn columns_are_chosen_by_name_and_in_that_order() {
        let vector = |name, length| (name, Content::Vector { found: Some(length), declared: None });
        let episode = episode(&[vector("arm", 3), ("raw", Content::Bytes), vector("force", 1)]);
        let of = |state: &[&str], action: Option<&str>| {
            let choice = Choice {
                state: state.iter().map(|name| (*name).to_owned()).collect(),
                action: action.map(str::to_owned),
                ..Choice::default()
            };
            Features::of(&episode, &choice, &Known::default()).map_err(|refusal| refusal.to_string())
        };
        assert_eq!(of(&[], None).unwrap().state, [(0, 3), (2, 1)]);
        let chosen = of(&["force", "arm"], Some("arm")).unwrap();
        assert_eq!((chosen.state.as_slice(), chosen.actions), (&[(2, 1), (0, 3)][..], Actions::Modality(0, 3)));
        let unknown = of(&["raw"], None).unwrap_err();
        assert_eq!(unknown, "\"raw\" is no sensor of numbers; of this episode they are arm, force");
        assert!(of(&[], Some("legs")).is_err());
        assert_eq!(of(&["arm", "arm"], None).unwrap_err(), "\"arm\" is chosen twice");
    }

    #[test]
    fn a_difference_is_named() {
        let refused = |other: &Features| features().check(other).unwrap_err().to_string();
        assert!(features().check(&features()).is_ok());
        assert_eq!(refused(&Features { fps: 20, ..features() }), "20 frames a second, and 30 in the data set");
        let mut wide = features();
        wide.cameras[0].1.width = 1280;
        let text = refused(&wide);
        assert!(text.starts_with("observation.images.cam is [480,1280,3]") && text.contains("[480,640,3]"), "{text}");
        let text = refused(&Features { actions: Actions::Absent, ..features() });
        assert!(text.starts_with("action is absent, and [2]"), "{text}");
    }
}
