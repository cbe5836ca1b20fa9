//! Values of `policy.json` with a smaller range than their types, as serde reads them.

use std::ops::Range;

use rapid_core::text;
use serde::Deserialize;
use serde::de::{Deserializer, Error, IntoDeserializer};

/// Longest side of a picture, pixels.
pub(super) type Side = Whole<1, 8192>;
/// Maximum length of a vector.
pub(super) const MAX_VALUES: i64 = 4096;

/// A whole number from `MIN` to `MAX`.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(try_from = "i64")]
pub(super) struct Whole<const MIN: i64, const MAX: i64>(usize);

impl<const MIN: i64, const MAX: i64> Whole<MIN, MAX> {
    pub(super) const fn get(self) -> usize {
        self.0
    }
}

impl<const MIN: i64, const MAX: i64> TryFrom<i64> for Whole<MIN, MAX> {
    type Error = String;

    fn try_from(number: i64) -> Result<Self, String> {
        let found = usize::try_from(number).ok().filter(|_| (MIN..=MAX).contains(&number));
        found.map(Self).ok_or_else(|| match MAX - MIN {
            0 => format!("{number} is not supported, only {MIN} is"),
            _ => format!("{number} is not between {MIN} and {MAX}"),
        })
    }
}

/// A number that fits into an f32.
#[derive(Deserialize)]
#[serde(try_from = "f64")]
struct Float(f32);

impl TryFrom<f64> for Float {
    type Error = String;

    #[expect(clippy::cast_possible_truncation, reason = "what becomes infinite is refused")]
    fn try_from(number: f64) -> Result<Self, String> {
        let float = number as f32;
        float
            .is_finite()
            .then_some(Self(float))
            .ok_or_else(|| format!("{number:e} is beyond the range of a 32-bit float"))
    }
}

/// Printable, non-empty text.
#[derive(Deserialize)]
#[serde(try_from = "String")]
struct Name(String);

impl TryFrom<String> for Name {
    type Error = &'static str;

    fn try_from(name: String) -> Result<Self, Self::Error> {
        match name.as_str() {
            "" => Err("is empty"),
            shown if text::plain(shown) != shown => Err("contains control characters"),
            _ => Ok(Self(name)),
        }
    }
}

pub(super) fn name<'de, D: Deserializer<'de>>(value: D) -> Result<String, D::Error> {
    Name::deserialize(value).map(|name| name.0)
}

pub(super) fn names<'de, D: Deserializer<'de>>(value: D) -> Result<Vec<String>, D::Error> {
    Vec::<Name>::deserialize(value).map(|names| names.into_iter().map(|name| name.0).collect())
}

pub(super) fn numbers<'de, D: Deserializer<'de>>(value: D) -> Result<Vec<f32>, D::Error> {
    Vec::<Float>::deserialize(value).map(|numbers| numbers.into_iter().map(|number| number.0).collect())
}

/// `[height, width]` or null.
pub(super) fn size<'de, D: Deserializer<'de>>(value: D) -> Result<Option<[usize; 2]>, D::Error> {
    Option::<[Side; 2]>::deserialize(value).map(|size| size.map(|sides| sides.map(Whole::get)))
}

/// `[begin, end]`, end not included, not empty.
pub(super) fn slice<'de, D: Deserializer<'de>>(value: D) -> Result<Range<usize>, D::Error> {
    let [begin, end] = <[Whole<0, MAX_VALUES>; 2]>::deserialize(value)?.map(Whole::get);
    if begin < end { Ok(begin..end) } else { Err(D::Error::custom(format!("[{begin}, {end}] is empty"))) }
}

pub(super) fn some_slice<'de, D: Deserializer<'de>>(value: D) -> Result<Option<Range<usize>>, D::Error> {
    slice(value).map(Some)
}

pub(super) fn whole<'de, D: Deserializer<'de>, const MIN: i64, const MAX: i64>(value: D) -> Result<usize, D::Error> {
    Whole::<MIN, MAX>::deserialize(value).map(Whole::get)
}

/// A variant of an enum without values, by its name; serde alone would also accept `{name: null}`.
pub(super) fn word<'de, D: Deserializer<'de>, T: Deserialize<'de>>(value: D) -> Result<T, D::Error> {
    T::deserialize(String::deserialize(value)?.into_deserializer())
}

/// The same, or null. Without such a function serde would let a key of type `Option` be omitted.
pub(super) fn word_or_null<'de, D: Deserializer<'de>, T: Deserialize<'de>>(value: D) -> Result<Option<T>, D::Error> {
    let given = Option::<String>::deserialize(value)?;
    given.map(|given| T::deserialize(given.into_deserializer())).transpose()
}

pub(super) fn file_name<'de, D: Deserializer<'de>>(value: D) -> Result<String, D::Error> {
    let file = name(value)?;
    if file.contains(['/', '\\']) || file.starts_with('.') {
        return Err(D::Error::custom(format!("\"{file}\" is not a plain file name")));
    }
    Ok(file)
}

pub(super) fn sha256<'de, D: Deserializer<'de>>(value: D) -> Result<String, D::Error> {
    let sha256 = name(value)?;
    if sha256.len() != 64 || !sha256.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return Err(D::Error::custom(format!("\"{sha256}\" is not a SHA-256")));
    }
    Ok(sha256.to_ascii_lowercase())
}

/// For a variant without keys of its own: no key is allowed.
pub(super) fn no_keys<'de, D: Deserializer<'de>>(value: D) -> Result<(), D::Error> {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Empty {}
    Empty::deserialize(value).map(|Empty {}| ())
}
