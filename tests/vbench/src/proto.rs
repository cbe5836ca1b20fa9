//! The subset of protobuf needed to read recorded messages: iterates over the fields of a message.
//!
//! Invariant: damaged input ends the iteration; it never causes a panic and never yields an invented field.

/// A field's value, still encoded if it has parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// int, uint, bool, enum.
    Varint(u64),
    /// fixed64, double.
    Fixed64(u64),
    /// fixed32, float.
    Fixed32(u32),
    /// string, bytes, message, packed repeated.
    Bytes(&'a [u8]),
}

/// The fields of a message, in the order they were written.
pub fn fields(mut message: &[u8]) -> impl Iterator<Item = (u32, Value<'_>)> {
    std::iter::from_fn(move || {
        let key = varint(&mut message)?;
        let value = match key & 7 {
            0 => Value::Varint(varint(&mut message)?),
            1 => Value::Fixed64(u64::from_le_bytes(take(&mut message, 8)?.try_into().ok()?)),
            2 => {
                let length = usize::try_from(varint(&mut message)?).ok()?;
                Value::Bytes(take(&mut message, length)?)
            }
            5 => Value::Fixed32(u32::from_le_bytes(take(&mut message, 4)?.try_into().ok()?)),
            _ => return None,
        };
        Some((u32::try_from(key >> 3).ok()?, value))
    })
}

/// The last occurrence of field `number`, which takes precedence.
pub fn field(message: &[u8], number: u32) -> Option<Value<'_>> {
    fields(message).filter(|(found, _)| *found == number).map(|(_, value)| value).last()
}

/// Field `number` as bytes; empty if absent, as in protobuf.
pub fn bytes(message: &[u8], number: u32) -> &[u8] {
    match field(message, number) {
        Some(Value::Bytes(bytes)) => bytes,
        _ => &[],
    }
}

/// Field `number` as a number of any width; 0 if absent, as in protobuf.
pub fn number(message: &[u8], number: u32) -> u64 {
    match field(message, number) {
        Some(Value::Varint(value) | Value::Fixed64(value)) => value,
        Some(Value::Fixed32(value)) => value.into(),
        _ => 0,
    }
}

/// A repeated double, packed or not.
pub fn doubles(message: &[u8], number: u32) -> Vec<f64> {
    let mut all = Vec::new();
    for (found, value) in fields(message) {
        match value {
            Value::Bytes(packed) if found == number => {
                all.extend(packed.chunks_exact(8).filter_map(|word| word.try_into().ok()).map(f64::from_le_bytes));
            }
            Value::Fixed64(bits) if found == number => all.push(f64::from_bits(bits)),
            _ => {}
        }
    }
    all
}

fn take<'a>(bytes: &mut &'a [u8], length: usize) -> Option<&'a [u8]> {
    let (head, rest) = bytes.split_at_checked(length)?;
    *bytes = rest;
    Some(head)
}

fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0u64;
    for shift in (0..64).step_by(7) {
        let byte = take(bytes, 1)?[0];
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn walks_every_wire_type() {
        let message =
            [&[0x08, 0x96, 0x01, 0x12, 2, b'h', b'i', 0x19][..], &7u64.to_le_bytes(), &[0x25, 1, 0, 0, 0]].concat();
        let all: Vec<_> = fields(&message).collect();
        let expected =
            [(1, Value::Varint(150)), (2, Value::Bytes(b"hi")), (3, Value::Fixed64(7)), (4, Value::Fixed32(1))];
        assert_eq!(all, expected);
        assert_eq!((number(&message, 1), number(&message, 9), bytes(&message, 2)), (150, 0, &b"hi"[..]));
    }

    #[test]
    fn reads_doubles_packed_and_not() {
        let packed = [&[0x12, 16][..], &1.5f64.to_le_bytes(), &2.5f64.to_le_bytes()].concat();
        let single = [&[0x11][..], &3.5f64.to_le_bytes()].concat();
        assert_eq!(doubles(&[packed, single].concat(), 2), [1.5, 2.5, 3.5]);
    }

    #[test]
    fn damage_ends_the_walk() {
        for message in [&[0x12, 200, 1][..], &[0x08], &[0x0b, 1], &[0x80; 12]] {
            assert_eq!(fields(message).count(), 0);
        }
    }
}
