//! The content of a message: as many numbers as the registry says, or nothing.
//!
//! Invariant: nothing here allocates for a message that is well formed.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error as _, IgnoredAny, MapAccess, SeqAccess, Visitor};

use crate::registry::Parse;

/// Reads exactly `values.len()` numbers from `message`; false if it holds anything else.
pub(super) fn numbers(parse: Parse, message: &[u8], values: &mut [f64]) -> bool {
    match parse {
        Parse::Csv => csv(message, values),
        Parse::Json => json(message, values),
        Parse::F32le => f32le(message, values),
        Parse::Raw => false,
    }
}

fn csv(message: &[u8], values: &mut [f64]) -> bool {
    let mut fields = message.split(|&byte| byte == b',');
    for value in values {
        let Some(number) = fields.next().and_then(decimal) else { return false };
        *value = number;
    }
    fields.next().is_none()
}

/// A number in decimal notation with blanks around it; `nan`, `inf` and `-inf` included.
fn decimal(field: &[u8]) -> Option<f64> {
    std::str::from_utf8(field.trim_ascii()).ok()?.parse().ok()
}

fn f32le(message: &[u8], values: &mut [f64]) -> bool {
    if message.len() != values.len() * 4 {
        return false;
    }
    for (value, bytes) in values.iter_mut().zip(message.chunks_exact(4)) {
        let mut four = [0; 4];
        four.copy_from_slice(bytes);
        *value = f64::from(f32::from_le_bytes(four));
    }
    true
}

fn json(message: &[u8], values: &mut [f64]) -> bool {
    let wished = values.len();
    let mut sink = Sink { values, count: 0 };
    let mut deserializer = serde_json::Deserializer::from_slice(message);
    let read = deserializer.deserialize_any(Document(&mut sink)).and_then(|()| deserializer.end());
    read.is_ok() && sink.count == wished
}

struct Sink<'a> {
    values: &'a mut [f64],
    count: usize,
}

impl Sink<'_> {
    fn push(&mut self, number: f64) -> bool {
        let Some(place) = self.values.get_mut(self.count) else { return false };
        *place = number;
        self.count += 1;
        true
    }
}

/// An array of numbers, or an object whose numeric values count in the order they stand in; its
/// other values (names, units, nested objects) are passed over.
struct Document<'a, 'b>(&'a mut Sink<'b>);

impl<'de> Visitor<'de> for Document<'_, '_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of numbers or an object")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut array: A) -> Result<(), A::Error> {
        while let Some(element) = array.next_element_seed(Element)? {
            let Some(number) = element else { return Err(A::Error::custom("not a number")) };
            if !self.0.push(number) {
                return Err(A::Error::custom("too many numbers"));
            }
        }
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut object: A) -> Result<(), A::Error> {
        while object.next_key::<IgnoredAny>()?.is_some() {
            if let Some(number) = object.next_value_seed(Element)?
                && !self.0.push(number)
            {
                return Err(A::Error::custom("too many numbers"));
            }
        }
        Ok(())
    }
}

/// Any value: `Some` if it is a number.
struct Element;

impl<'de> DeserializeSeed<'de> for Element {
    type Value = Option<f64>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Element {
    type Value = Option<f64>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any value")
    }

    fn visit_f64<E>(self, number: f64) -> Result<Self::Value, E> {
        Ok(Some(number))
    }

    fn visit_i64<E>(self, number: i64) -> Result<Self::Value, E> {
        Ok(Some(number as f64))
    }

    fn visit_u64<E>(self, number: u64) -> Result<Self::Value, E> {
        Ok(Some(number as f64))
    }

    fn visit_bool<E>(self, _: bool) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_str<E>(self, _: &str) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_unit<E>(self) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut array: A) -> Result<Self::Value, A::Error> {
        while array.next_element::<IgnoredAny>()?.is_some() {}
        Ok(None)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut object: A) -> Result<Self::Value, A::Error> {
        while object.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
        Ok(None)
    }
}

#[cfg(test)]
mod tests;
