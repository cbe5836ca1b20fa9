//! Reads a part of `policy.json` into a type that derives `Deserialize`, and reports every error with its path.
//!
//! serde stops at the first error. To report all of them in one pass, a wrong value is replaced by the example of its
//! key (see [`KEYS`]) and the part is read again; the result of such a pass is discarded.
//!
//! Invariant: text taken from the file is shown without control characters.

use std::fmt;

use rapid_core::text;
use rapid_registry::{Diagnostic, did_you_mean};
use serde::Deserialize;
use serde::de::{DeserializeOwned, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};
use serde_path_to_error::Segment;

use super::spec::BundleErrors;

/// Maximum number of reported problems; a file with more was not written by a policy exporter.
const MOST_PROBLEMS: usize = 100;

#[derive(Debug)]
pub(super) struct Problems {
    file: String,
    found: Vec<Diagnostic>,
}

impl Problems {
    pub(super) fn new(file: &str) -> Self {
        Self { file: text::plain(file).into_owned(), found: Vec::new() }
    }

    /// Reports a problem at the path `entry`; with an empty path, of the whole file.
    pub(super) fn report(&mut self, entry: &str, message: impl AsRef<str>, fix: impl AsRef<str>) {
        self.report_at((0, 0), entry, message.as_ref(), fix.as_ref());
    }

    /// Reports a wrong value at the path `entry`; the fix names what to write there.
    pub(super) fn wrong(&mut self, entry: &str, message: impl AsRef<str>) {
        self.report(entry, message, fix_at(entry));
    }

    /// Reports a problem at a line and column, both from 1.
    pub(super) fn report_at(&mut self, (line, column): (usize, usize), entry: &str, message: &str, fix: &str) {
        if self.found.len() < MOST_PROBLEMS {
            self.found.push(Diagnostic {
                file: self.file.clone(),
                line,
                column,
                entry: (!entry.is_empty()).then(|| text::plain(entry).into_owned()),
                message: text::plain(message).into_owned(),
                fix: Some(text::plain(fix).into_owned()),
            });
        }
    }

    /// Reports a problem of the whole file, unless there are problems already.
    pub(super) fn report_first(&mut self, message: &str, fix: &str) {
        if self.found.is_empty() {
            self.report("", message, fix);
        }
    }

    /// `Err` with all problems so far, if there are any.
    pub(super) fn check(self) -> Result<(), BundleErrors> {
        if self.found.is_empty() { Ok(()) } else { Err(BundleErrors { diagnostics: self.found }) }
    }
}

/// Reads the object `value` at the path `entry`. `None` if any part of it is wrong, which is reported.
pub(super) fn read<T: DeserializeOwned>(entry: &str, value: &Value, problems: &mut Problems) -> Option<T> {
    let keys = object(entry, value, problems)?;
    read_part(entry, "", Value::Object(keys), problems)
}

/// Reads an object whose key `tag` names the variant of `T` that its other keys describe.
pub(super) fn read_tagged<T: DeserializeOwned>(
    entry: &str,
    tag: &str,
    value: &Value,
    problems: &mut Problems,
) -> Option<T> {
    let mut keys = object(entry, value, problems)?;
    match keys.remove(tag) {
        Some(Value::String(variant)) => {
            // The form in which serde itself tags enums: it preserves the path to the error.
            let tagged = Value::Object(Map::from_iter([(variant, Value::Object(keys))]));
            return read_part(entry, tag, tagged, problems);
        }
        Some(_) => problems.wrong(&join(entry, tag), "must be text"),
        None => problems.wrong(&join(entry, tag), "is missing"),
    }
    None
}

/// serde also accepts a list for a struct.
fn object(entry: &str, value: &Value, problems: &mut Problems) -> Option<Map<String, Value>> {
    let object = Map::deserialize(value);
    object.map_err(|error| problems.wrong(entry, plain(&error.to_string()))).ok()
}

fn read_part<T: DeserializeOwned>(entry: &str, tag: &str, mut value: Value, problems: &mut Problems) -> Option<T> {
    let mut is_whole = true;
    while problems.found.len() < MOST_PROBLEMS {
        let error = match serde_path_to_error::deserialize(&value) {
            Ok(read) => return is_whole.then_some(read),
            Err(error) => error,
        };
        is_whole = false;
        let error = KeyError::new(entry, tag, &error);
        problems.report(&error.entry, &error.message, &error.fix);
        if error.repair(&mut value).is_none() {
            break;
        }
    }
    None
}

/// An error of serde, for people.
struct KeyError {
    /// The path of its key.
    entry: String,
    message: String,
    fix: String,
    /// Path from the part being read to the key or the value.
    path: Vec<Segment>,
    /// A valid value of the key; `None` if there is none.
    example: Option<Value>,
}

impl KeyError {
    fn new(entry: &str, tag: &str, error: &serde_path_to_error::Error<serde_json::Error>) -> Self {
        let mut path: Vec<Segment> = error.path().iter().cloned().collect();
        let cause = error.inner().to_string();
        // The name that the message concerns, followed by the known ones.
        let names: Vec<&str> = cause.split('`').skip(1).step_by(2).collect();
        let (name, known) = names.split_first().map_or(("", [].as_slice()), |(name, known)| (*name, known));
        let mut known = known.to_vec();
        let is_missing = cause.starts_with("missing field");
        if is_missing {
            path.push(Segment::Map { key: name.to_owned() });
        }
        let mut place = path.iter().fold(entry.to_owned(), |place, segment| match segment {
            Segment::Seq { index } => format!("{place}[{index}]"),
            Segment::Enum { .. } => place,
            segment => join(&place, &segment.to_string()),
        });
        let key = find(&place);
        let mut fix = key.map_or_else(|| EXPORT.to_owned(), Key::fix);
        let mut example = key.and_then(|key| serde_json::from_str(key.example).ok());
        let message = if is_missing {
            "is missing".to_owned()
        } else if cause.starts_with("unknown field") {
            if !tag.is_empty() && place == join(entry, name) {
                known.insert(0, tag);
            }
            (fix, example) = (did_you_mean(name, &known, "the keys here are"), None);
            "unknown key".to_owned()
        } else if cause.starts_with("unknown variant") {
            fix = did_you_mean(name, &known, "write one of");
            if path.iter().all(|segment| matches!(segment, Segment::Enum { .. })) {
                (place, example) = (join(&place, tag), None);
            }
            format!("unknown value \"{name}\"")
        } else {
            plain(&cause)
        };
        Self { entry: place, message, fix, path, example }
    }

    /// Removes the key from `value`, or replaces its value by the example. `None` if that is not possible.
    fn repair(self, value: &mut Value) -> Option<()> {
        let mut path = self.path;
        let last = path.pop()?;
        let mut at = value;
        for segment in &path {
            at = match segment {
                Segment::Seq { index } => at.get_mut(index)?,
                Segment::Map { key } | Segment::Enum { variant: key } => at.get_mut(key)?,
                Segment::Unknown => return None,
            };
        }
        match (last, self.example) {
            (Segment::Seq { index }, Some(example)) => {
                let example = example.get(0).cloned().unwrap_or(example);
                let replaced = std::mem::replace(at.get_mut(index)?, example.clone());
                // If the example itself is refused, the loop would never end.
                (replaced != example).then_some(())
            }
            (Segment::Map { key }, Some(example)) => {
                let replaced = at.as_object_mut()?.insert(key, example.clone());
                (replaced != Some(example)).then_some(())
            }
            (Segment::Map { key }, None) => at.as_object_mut()?.remove(&key).map(|_| ()),
            _ => None,
        }
    }
}

/// The path of `name` below `entry`.
fn join(entry: &str, name: &str) -> String {
    let point = if entry.is_empty() || name.is_empty() { "" } else { "." };
    format!("{entry}{point}{name}")
}

/// serde's message about a value of the wrong type or length, without Rust terms.
fn plain(cause: &str) -> String {
    if let Some((found, expected)) =
        cause.strip_prefix("invalid length ").and_then(|cause| cause.split_once(", expected an array of length "))
    {
        return format!("has {found} entries instead of {expected}");
    }
    let wrong = cause.strip_prefix("invalid type: ").or_else(|| cause.strip_prefix("invalid value: "));
    let Some((found, expected)) = wrong.and_then(|cause| cause.rsplit_once(", expected ")) else {
        return cause.to_owned();
    };
    let expected = match expected {
        "a string" => "text".to_owned(),
        "a boolean" => "true or false".to_owned(),
        "f64" | "f32" => "a number".to_owned(),
        "i64" => "a whole number".to_owned(),
        "a sequence" => "a list".to_owned(),
        "a map" => "an object".to_owned(),
        "unit" => "null".to_owned(),
        expected => expected.replace("an array of length", "a list of"),
    };
    let found = match found {
        "sequence" => "a list".to_owned(),
        "map" => "an object".to_owned(),
        found => found
            .replace("string", "text")
            .replace("floating point", "the decimal number")
            .replace("integer", "the number")
            .replace('`', ""),
    };
    format!("must be {expected}, but is {found}")
}

/// A value without duplicate keys: a `serde_json::Value` would silently keep the last.
pub(super) struct Strict(pub(super) Value);

impl<'de> Deserialize<'de> for Strict {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Reader)
    }
}

struct Reader;

impl<'de> Visitor<'de> for Reader {
    type Value = Strict;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON value")
    }

    fn visit_unit<E>(self) -> Result<Strict, E> {
        Ok(Strict(Value::Null))
    }

    fn visit_bool<E>(self, value: bool) -> Result<Strict, E> {
        Ok(Strict(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Strict, E> {
        Ok(Strict(value.into()))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Strict, E> {
        Ok(Strict(value.into()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Strict, E> {
        Ok(Strict(value.into()))
    }

    fn visit_str<E>(self, value: &str) -> Result<Strict, E> {
        Ok(Strict(value.into()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Strict, A::Error> {
        let mut values = Vec::new();
        while let Some(Strict(value)) = list.next_element()? {
            values.push(value);
        }
        Ok(Strict(Value::Array(values)))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Strict, A::Error> {
        let mut map = Map::new();
        while let Some((key, Strict(value))) = entries.next_entry::<String, Strict>()? {
            if map.contains_key(&key) {
                return Err(A::Error::custom(format!("duplicate key \"{key}\"")));
            }
            map.insert(key, value);
        }
        Ok(Strict(Value::Object(map)))
    }
}

/// The fix for a path without a key here.
const EXPORT: &str = "export the bundle again";

/// A key and an example of its value.
#[derive(Debug, Clone, Copy)]
struct Key {
    /// The end of its path, without list indices.
    path: &'static str,
    what: &'static str,
    /// A valid value, as JSON.
    example: &'static str,
}

impl Key {
    /// What to write there.
    fn fix(&self) -> String {
        match self.path.rsplit('.').next().unwrap_or_default() {
            "[]" | "" => format!("write {}", self.what),
            name => format!("write \"{name}\": {}", self.what),
        }
    }
}

/// The fix for the value at a path such as `observations[0].shape`.
fn fix_at(path: &str) -> String {
    find(path).map_or_else(|| EXPORT.to_owned(), Key::fix)
}

/// The key of the longest end of `path`.
fn find(path: &str) -> Option<&'static Key> {
    let path: Vec<&str> = path.split('.').collect();
    let names = |is_element: bool| {
        let name = |part: &&str| part.split('[').next().unwrap_or_default().to_owned();
        let mut names: Vec<String> = path.iter().map(name).collect();
        if is_element && path.last().is_some_and(|last| last.ends_with(']')) {
            names.push("[]".to_owned());
        }
        names
    };
    [names(true), names(false)].iter().find_map(|names| {
        (0..names.len()).find_map(|from| {
            let end = names.get(from..).unwrap_or_default().join(".");
            KEYS.iter().find(|key| key.path == end)
        })
    })
}

macro_rules! keys {
    ($($path:literal: $what:literal, $example:literal;)*) => {
        &[$(Key { path: $path, what: $what, example: $example }),*]
    };
}

#[rustfmt::skip]
const KEYS: &[Key] = keys! {
    "": "an object: {\"format\": \"rapid-policy/1\", \"name\": .., ..}", "{}";
    "format": "\"rapid-policy/1\"", "\"rapid-policy/1\"";
    "name": "the name of the policy, as text", "\"policy\"";
    "mask_aware": "true if it was trained with modalities left out, else false", "true";
    "n_obs_steps": "how many observations a chunk is computed from, 1 to 64", "1";
    "horizon": "how many actions a chunk has, 1 to 1024", "16";
    "n_action_steps": "how many of them are executed before the next chunk, 1 to horizon - action_start", "1";
    "action_start": "the index in a chunk of the action of the last observation's tick: n_obs_steps - 1 (LeRobot) or 0 (UMI)", "0";
    "control_hz": "actions a second, 0.1 to 1000", "10";
    "max_observation_age_ms": "how old an observation may be, 1 to 60000 ms", "100";
    "observations": "a list of what the policy observes, at least one", "[]";
    "observations.[]": "an object with key, kind, modality, required, shape and normalization", "{}";
    "mask": "{\"input\": .., \"order\": [..], \"absent\": \"zero_embedding\"}, or null if it has no mask input", "null";
    "action": "an object: what the policy moves", "{}";
    "scheduler": "an object: the diffusion process, in the words of diffusers", "{}";
    "graphs": "{\"encoder\": {\"file\": .., \"sha256\": ..}, \"denoiser\": {..}}", "{}";
    "training": "an object with whatever is worth knowing about the training; it may be {}", "{}";

    "key": "the name of the encoder's input, as text", "\"key\"";
    "kind": "\"image\" or \"vector\"; this program knows no other", "\"image\"";
    "modality": "the name of the device in devices.toml", "\"modality\"";
    "required": "true if the policy must not run without it, else false", "true";
    "shape": "[3, height, width] after resize and crop, sides from 1 to 8192; of a vector [how many values, 1 to 4096]", "[3, 96, 96]";
    "color": "\"rgb\" or \"bgr\"", "\"rgb\"";
    "resize": "[height, width] that pictures are resized to, or null", "[96, 96]";
    "crop": "[height, width] of the middle that is kept after the resize, or null", "[96, 96]";
    "operation": "\"diff_to_reference\" of a picture, \"first_of_run\" of a vector, or null", "null";
    "when_absent": "\"zero\" or {\"hold_last_ms\": 1 to 600000}; leave it out for zero", "\"zero\"";
    "down_sample_steps": "how many ticks are between two of its steps, 1 to 64; leave it out for 1", "1";
    "history": "{\"steps\": 2 to 64, \"valid\": \"the name of another input of the encoder\"}, or leave it out", "null";
    "history.steps": "how many steps it has, 2 to 64", "2";
    "history.valid": "the name of the encoder's input that says which steps have a sample, as text", "\"valid\"";
    "observations.rotation": "\"rotation_6d\" if slice names a quaternion; leave it out for numbers as they are", "null";
    "observations.slice": "[begin, end] of the sample's values, end not included; leave it out for all of them", "[0, 1]";

    "observations.normalization": "{\"mode\": \"min_max\", \"min\": [..], \"max\": [..]}, or mode \"mean_std\" or \"identity\"", "{}";
    "mode": "\"min_max\", \"mean_std\" or \"identity\"", "\"identity\"";
    "min": "the smallest values, one number per dimension", "[0]";
    "max": "the largest values, one number per dimension, each above its min", "[1]";
    "mean": "the means, one number per dimension", "[0]";
    "std": "the standard deviations, one number per dimension, none below 0, with eps above 0", "[1]";
    "eps": "what is added to each std, from 0 to 1; leave it out for 0", "0";
    "action.normalization": "a list of {\"slice\": [begin, end], \"mode\": ..} that cover every value once", "[]";
    "action.normalization.[]": "{\"slice\": [begin, end], \"mode\": ..}", "{}";
    "normalization.slice": "[begin, end] of the action's values, end not included", "[0, 1]";

    "input": "the name of the encoder's mask input", "\"mask\"";
    "order": "the modality of each element of the mask, each once", "[]";
    "absent": "\"zero_embedding\"", "\"zero_embedding\"";

    "actuator": "the name of the device in devices.toml that is moved", "\"actuator\"";
    "action.shape": "[how many values, 1 to 1024]", "[1]";
    "names": "a name for each value of an action", "[\"name\"]";
    "units": "the unit of each value of an action, \"1\" for none", "[\"1\"]";
    "representation": "\"absolute\", \"relative\" or \"delta\"", "\"absolute\"";
    "action.rotation": "\"rotation_6d\" or \"quaternion\"; leave it out for actions without a rotation", "null";
    "action.base": "{\"modality\": .., \"position\": [begin, end], \"rotation\": [begin, end]}: where the pose is that actions are relative to", "{}";
    "base.modality": "the modality of a required vector observation", "\"modality\"";
    "base.position": "[begin, end] of the sample's 3 values x, y, z, end not included", "[0, 3]";
    "base.rotation": "[begin, end] of the sample's quaternion x y z w, end not included, if the action has a rotation", "[3, 7]";
    "limits": "{\"min\": [..], \"max\": [..]}, beyond which no action goes", "{}";
    "limits.min": "the smallest values that may be executed, one number per dimension", "[0]";
    "limits.max": "the largest values that may be executed, none below its min", "[1]";

    "type": "\"DDIM\" or \"DDPM\"", "\"DDIM\"";
    "num_train_timesteps": "steps of the forward process, 1 to 10000", "100";
    "beta_schedule": "\"squaredcos_cap_v2\", \"linear\" or \"scaled_linear\"", "\"linear\"";
    "beta_start": "the first beta, 0.000001 to 0.999", "0.1";
    "beta_end": "the last beta, up to 0.999 and not below beta_start", "0.1";
    "prediction_type": "\"epsilon\", \"sample\" or \"v_prediction\"", "\"sample\"";
    "clip_sample": "true or false", "true";
    "clip_sample_range": "a number, 0.000001 to 1000", "1";
    "set_alpha_to_one": "true or false", "true";
    "steps_offset": "a whole number from 0, small enough that no timestep reaches num_train_timesteps", "0";
    "timestep_spacing": "\"leading\", \"trailing\" or \"linspace\"", "\"leading\"";
    "num_inference_steps": "how many timesteps are visited, 1 to num_train_timesteps", "1";

    "encoder": "{\"file\": \"encoder.onnx\", \"sha256\": ..}", "{}";
    "denoiser": "{\"file\": \"denoiser.onnx\", \"sha256\": ..}", "{}";
    "file": "the name of a file in the bundle's folder, without a path", "\"a\"";
    "sha256": "the 64 hexadecimal digits that sha256sum prints for the file", "\"0000000000000000000000000000000000000000000000000000000000000000\"";
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn examples_are_json() {
        for key in KEYS {
            serde_json::from_str::<serde_json::Value>(key.example)
                .unwrap_or_else(|error| panic!("{}: {error}", key.path));
        }
    }

    #[test]
    fn the_longest_end_of_a_path_is_found() {
        let found = |path| find(path).map(|key| key.path);
        assert_eq!(found("action.limits.max[2]"), Some("limits.max"));
        assert_eq!(found("observations[2].normalization.max[2]"), Some("max"));
        assert_eq!(found("action.normalization[0]"), Some("action.normalization.[]"));
        assert_eq!(found("observations[0].shape[1]"), Some("shape"));
        assert_eq!(found(""), Some(""));
        assert_eq!(found("none.of.these"), None);
    }
}
