//! The keys of a table of `devices.toml`, each declared once, by `keys!`: name, type with its range, default, meaning.
//!
//! From a declaration follow the struct with its fields, the read with the messages of `Section`, the list of known keys
//! with "did you mean", the reference of all keys (`docs/keys.md`) and the schema for editors (`docs/devices.schema.json`).
//!
//! Invariant: what a key may be is not stated anywhere else.

#![expect(clippy::redundant_closure_for_method_calls, reason = "the methods are of a section of one lifetime")]

mod documents;

use std::fmt::{Debug, Display};
use std::marker::PhantomData;
use std::time::Duration;

use serde_json::{Value as Json, json};

use super::section::Section;
use super::units::{show_duration, show_size};

pub use documents::{reference, schema_text};

/// A key of a table.
#[derive(Debug)]
pub(crate) struct Key {
    pub(crate) name: &'static str,
    /// What it means, for the reference.
    pub(crate) meaning: &'static str,
    pub(crate) about: fn() -> About,
    /// What applies without it, as it would be written, or in words; [`NEEDED`] if nothing does.
    pub(crate) default: fn() -> String,
}

/// A table without the key is an error.
pub(crate) const NEEDED: &str = "needed";

/// The key of a table, whose keys are declared elsewhere, and which is read by itself.
pub(crate) const fn table(name: &'static str, meaning: &'static str, about: fn() -> About) -> Key {
    Key { name, meaning, about, default: String::new }
}

/// The keys of a table, in groups.
pub(crate) type Keys = &'static [&'static [Key]];

/// What the value of a key may be.
#[derive(Debug)]
pub(crate) enum About {
    /// Not a table of known keys: in words, and as a schema.
    Value(String, Json),
    /// A table with these keys.
    Table(Keys),
    /// Tables with these keys, in a list.
    List(Keys),
    /// A table of tables with these keys, each with a name of the user's.
    Named(Keys),
}

/// A type of values: how one is read, written and described.
pub(crate) trait Type {
    /// What is read.
    type Value;

    /// The value of `key`, if it has a valid one; a problem is noted.
    fn read(&self, table: &Section<'_>, key: &str) -> Option<Self::Value>;

    /// As it is written.
    fn shown(&self, value: &Self::Value) -> String;

    /// In words, and as a schema.
    fn about(&self) -> (String, Json);
}

/// A whole number in this range.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Whole<T>(i64, i64, PhantomData<T>);

pub(crate) const fn whole<T>(least: i64, most: i64) -> Whole<T> {
    Whole(least, most, PhantomData)
}

impl<T: TryFrom<i64> + Display> Type for Whole<T> {
    type Value = T;

    fn read(&self, table: &Section<'_>, key: &str) -> Option<T> {
        table.integer(key, self.0..=self.1)
    }

    fn shown(&self, value: &T) -> String {
        value.to_string()
    }

    fn about(&self) -> (String, Json) {
        let Self(least, most, _) = self;
        (format!("a whole number, {least} to {most}"), json!({"type": "integer", "minimum": least, "maximum": most}))
    }
}

/// Ranges of values that are written with a unit.
macro_rules! with_unit {
    ($($(#[$doc:meta])* $name:ident($of:ty) = $getter:ident, $what:literal, $show:ident;)+) => {$(
        $(#[$doc])*
        #[derive(Debug, Clone, Copy)]
        pub(crate) struct $name(pub(crate) $of, pub(crate) $of);

        impl Type for $name {
            type Value = $of;

            fn read(&self, table: &Section<'_>, key: &str) -> Option<$of> {
                table.$getter(key, self.0..=self.1)
            }

            fn shown(&self, value: &$of) -> String {
                format!("{:?}", $show(*value))
            }

            fn about(&self) -> (String, Json) {
                let words = format!("{}, {} to {}", $what, $show(self.0), $show(self.1));
                (words, json!({"type": "string", "pattern": "[0-9]"}))
            }
        }
    )+};
}

with_unit! {
    /// A duration in this range.
    Time(Duration) = duration, "a duration", show_duration;
    /// A size in this range, bytes.
    Size(u64) = size, "a size", show_size;
}

/// A number in this range, finite.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Real(pub(crate) f64, pub(crate) f64);

impl Real {
    /// Every finite number.
    pub(crate) const ANY: Self = Self(f64::MIN, f64::MAX);
}

impl Type for Real {
    type Value = f64;

    fn read(&self, table: &Section<'_>, key: &str) -> Option<f64> {
        table.number(key, self.0..=self.1)
    }

    fn shown(&self, value: &f64) -> String {
        value.to_string()
    }

    fn about(&self) -> (String, Json) {
        let Self(least, most) = self;
        if *most >= f64::MAX {
            return ("a number".to_owned(), json!({"type": "number"}));
        }
        (format!("a number, {least} to {most}"), json!({"type": "number", "minimum": least, "maximum": most}))
    }
}

/// A duration of at least this and at most an hour, or "never": no duration.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TimeOrNever(pub(crate) Duration);

impl TimeOrNever {
    const fn time(self) -> Time {
        Time(self.0, Duration::from_hours(1))
    }
}

impl Type for TimeOrNever {
    type Value = Option<Duration>;

    fn read(&self, table: &Section<'_>, key: &str) -> Option<Option<Duration>> {
        if table.word(key) == Some("never") { Some(None) } else { self.time().read(table, key).map(Some) }
    }

    fn shown(&self, value: &Option<Duration>) -> String {
        value.map_or_else(|| "\"never\"".to_owned(), |value| self.time().shown(&value))
    }

    fn about(&self) -> (String, Json) {
        let (words, _) = self.time().about();
        (format!("{words}, or `\"never\"`"), json!({"type": "string", "pattern": "[0-9]|^never$"}))
    }
}

/// One of these words.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Words<T: 'static>(pub(crate) &'static [(&'static str, T)]);

impl<T: Copy + PartialEq> Type for Words<T> {
    type Value = T;

    fn read(&self, table: &Section<'_>, key: &str) -> Option<T> {
        table.choice(key, self.0)
    }

    fn shown(&self, value: &T) -> String {
        let word = self.0.iter().find(|(_, known)| known == value).map_or("", |(word, _)| word);
        format!("{word:?}")
    }

    fn about(&self) -> (String, Json) {
        let words: Vec<&str> = self.0.iter().map(|(word, _)| *word).collect();
        let shown: Vec<String> = words.iter().map(|word| format!("`{word:?}`")).collect();
        (shown.join(", "), json!({"enum": words}))
    }
}

/// Something else: how it is read, and what it is in words and as a schema.
#[derive(Debug)]
pub(crate) struct Own<T> {
    read: fn(&Section<'_>, &str) -> Option<T>,
    words: &'static str,
    schema: &'static str,
}

pub(crate) const fn own<T>(
    read: fn(&Section<'_>, &str) -> Option<T>,
    words: &'static str,
    schema: &'static str,
) -> Own<T> {
    Own { read, words, schema }
}

/// Text of a certain form.
pub(crate) const fn text<T>(read: fn(&Section<'_>, &str) -> Option<T>, words: &'static str) -> Own<T> {
    own(read, words, r#"{"type": "string"}"#)
}

pub(crate) const TEXT: Own<String> = text(|table, key| table.text(key).map(str::to_owned), "text");
pub(crate) const FLAG: Own<bool> = own(|table, key| table.flag(key), "true or false", r#"{"type": "boolean"}"#);
pub(crate) const TEXTS: Own<Vec<String>> = texts(|table, key| table.texts(key), "a list of texts");
pub(crate) const NUMBERS: Own<Vec<f64>> = numbers(|table, key| table.numbers(key), "a list of numbers");

pub(crate) const fn texts<T>(read: fn(&Section<'_>, &str) -> Option<T>, words: &'static str) -> Own<T> {
    own(read, words, r#"{"type": "array", "items": {"type": "string"}}"#)
}

pub(crate) const fn numbers<T>(read: fn(&Section<'_>, &str) -> Option<T>, words: &'static str) -> Own<T> {
    own(read, words, r#"{"type": "array", "items": {"type": "number"}}"#)
}

impl<T: Debug> Type for Own<T> {
    type Value = T;

    fn read(&self, table: &Section<'_>, key: &str) -> Option<T> {
        (self.read)(table, key)
    }

    fn shown(&self, value: &T) -> String {
        format!("{value:?}")
    }

    fn about(&self) -> (String, Json) {
        (self.words.to_owned(), serde_json::from_str(self.schema).unwrap_or_default())
    }
}

/// Declares the keys of a table: a struct with a field for each, or a list of keys alone, whose values are read one by one.
///
/// ```text
/// keys! {
///     /// What the table is.
///     pub struct Example {
///         /// What it means: for the reference, and the field's comment.
///         width: u32 = whole::<u32>(1, 8192), or 640;         // 640 without the key
///         torque: f64 = Real(0.001, 200.0), within limits(kind), usually "a tenth of its type's", or_else 0.1 * most(kind);
///         kind "type": Option<Kind> = Words(&KINDS), need "write type = ...";
///     } => {
///         /// A table, whose keys are declared elsewhere, and which is read by itself.
///         brake = About::Table(&[BrakeKeys::KEYS]);
///     }
/// }
/// ```
///
/// `within` and `or_else` may speak of the fields above, and of what is passed: `struct Example(most: f64)`. `Example::read`
/// reads a table, `Example::values` one that has other keys too; `Example::KEYS` are its keys.
macro_rules! keys {
    ($($(#[$meta:meta])* $vis:vis struct $name:ident $(($arg:ident: $arg_type:ty))? { $(
        $(#[doc = $doc:literal])+
        $field:ident $($key:literal)?: $of:ty = $type:expr
        $(, within $within:expr)? $(, usually $usual:literal)? $(, or $default:expr)? $(, or_else $else:expr)? $(, need $fix:expr)?;
    )+ } $(=> { $( $(#[doc = $meaning:literal])+ $table:ident = $about:expr; )+ })?)+) => {$(
        $(#[$meta])*
        $vis struct $name {
            $($(#[doc = $doc])+ $vis $field: $of,)+
        }

        impl $name {
            /// The keys of its table.
            pub(crate) const KEYS: &'static [$crate::keys::Key] = &[
                $($crate::keys::keys!(@key $field $($key)?, ($($doc),+), $type
                    $(, usually $usual)? $(, or $default)? $(, need $fix)?),)+
                $($($crate::keys::keys!(@below $table, ($($meaning),+), $about),)+)?
            ];

            /// Reads a table that has these keys alone, and notes every problem.
            #[allow(dead_code, reason = "a table with other keys too is not read by it")]
            pub(crate) fn read(table: &$crate::section::Section<'_> $(, $arg: $arg_type)?) -> Self {
                table.known(&[Self::KEYS]);
                Self::values(table $(, $arg)?)
            }

            /// Reads the keys of a table, and notes every problem.
            pub(crate) fn values(table: &$crate::section::Section<'_> $(, $arg: $arg_type)?) -> Self {
                use $crate::keys::Type as _;
                $(let $field: $of = {
                    let name = $crate::keys::keys!(@name $field $($key)?);
                    $(table.need(name, $fix);)?
                    let read = $crate::keys::keys!(@either ($type) $(($within))?).read(table, name);
                    $crate::keys::keys!(@value read $($default)? $($else)?)
                };)+
                Self { $($field),+ }
            }
        }
    )+};
    ($(#[$meta:meta])* $vis:vis const $name:ident { $(
        $(#[doc = $doc:literal])+
        $field:ident = $type:expr $(, usually $usual:literal)? $(, need $fix:expr)?;
    )* } $(=> { $( $(#[doc = $meaning:literal])+ $table:ident = $about:expr; )+ })?) => {
        $(#[$meta])*
        $vis const $name: &[$crate::keys::Key] = &[
            $($crate::keys::keys!(@key $field, ($($doc),+), $type $(, usually $usual)? $(, need $fix)?),)*
            $($($crate::keys::keys!(@below $table, ($($meaning),+), $about),)+)?
        ];
    };
    (@key $field:ident $($key:literal)?, ($($doc:literal),+), $type:expr
        $(, usually $usual:literal)? $(, or $default:expr)? $(, need $fix:expr)?) => {
        $crate::keys::Key {
            name: $crate::keys::keys!(@name $field $($key)?),
            meaning: concat!($($doc),+),
            about: || {
                let (words, schema) = $crate::keys::Type::about(&$type);
                $crate::keys::About::Value(words, schema)
            },
            default: || $crate::keys::keys!(@default $type $(, usually $usual)? $(, or $default)? $(, need $fix)?),
        }
    };
    (@below $table:ident, ($($meaning:literal),+), $about:expr) => {
        $crate::keys::table(stringify!($table), concat!($($meaning),+), || $about)
    };
    (@name $field:ident) => { stringify!($field) };
    (@name $field:ident $key:literal) => { $key };
    (@either ($type:expr)) => { $type };
    (@either ($type:expr) ($within:expr)) => { $within };
    (@value $read:ident) => { $read };
    (@value $read:ident $default:expr) => { $read.unwrap_or_else(|| $default) };
    (@default $type:expr, usually $usual:literal $(, or $default:expr)?) => { $usual.to_owned() };
    (@default $type:expr, or $default:expr) => { $crate::keys::Type::shown(&$type, &$default) };
    (@default $type:expr, need $fix:expr) => { $crate::keys::NEEDED.to_owned() };
    (@default $type:expr) => { String::new() };
}
pub(crate) use keys;
