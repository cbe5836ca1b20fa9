//! Reading untrusted bytes: MCAP's fields and protobuf's.
//!
//! Invariant: no bytes cause a panic here, or an allocation longer than they are.

use std::collections::BTreeMap;

/// Bytes still to be read. Each method takes what it returns off the front; `None` when the bytes
/// do not hold it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Fields<'a>(pub(crate) &'a [u8]);

impl<'a> Fields<'a> {
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*head)
    }

    pub(crate) fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub(crate) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(crate) fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub(crate) fn bytes(&mut self, count: u64) -> Option<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(usize::try_from(count).ok()?)?;
        self.0 = rest;
        Some(head)
    }

    /// MCAP's string: a u32 count of bytes before it.
    pub(crate) fn string(&mut self) -> Option<&'a str> {
        let count = self.u32()?;
        std::str::from_utf8(self.bytes(count.into())?).ok()
    }

    /// MCAP's map of strings: a u32 count of bytes before it.
    pub(crate) fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let count = self.u32()?;
        let mut pairs = Fields(self.bytes(count.into())?);
        let mut map = BTreeMap::new();
        while !pairs.0.is_empty() {
            map.insert(pairs.string()?.to_owned(), pairs.string()?.to_owned());
        }
        Some(map)
    }

    fn varint(&mut self) -> Option<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = self.u8()?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                return Some(value);
            }
        }
        None
    }
}

/// A field of a protobuf message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Proto<'a> {
    /// A varint.
    Varint(u64),
    /// The bits of a fixed 64-bit field.
    Fixed64(u64),
    /// The bits of a fixed 32-bit field.
    Fixed32(u32),
    /// Bytes, text or a message.
    Bytes(&'a [u8]),
}

impl<'a> Proto<'a> {
    /// A number; of a field of bytes, 0.
    pub fn number(self) -> u64 {
        match self {
            Self::Varint(number) | Self::Fixed64(number) => number,
            Self::Fixed32(number) => number.into(),
            Self::Bytes(_) => 0,
        }
    }

    /// A `sint64`.
    pub(crate) fn zigzag(self) -> i64 {
        let number = self.number();
        (number >> 1).cast_signed() ^ -(number & 1).cast_signed()
    }

    /// The bytes; of a number, none.
    pub fn bytes(self) -> &'a [u8] {
        match self {
            Self::Bytes(bytes) => bytes,
            _ => &[],
        }
    }
}

/// The fields of a protobuf message, until its end or the first invalid byte.
pub fn protobuf(message: &[u8]) -> impl Iterator<Item = (u64, Proto<'_>)> {
    whole_protobuf(message).map_while(|field| field)
}

/// The fields of a protobuf message; one `None` at the end if the bytes are not a whole message.
pub fn whole_protobuf(message: &[u8]) -> impl Iterator<Item = Option<(u64, Proto<'_>)>> {
    let mut fields = Fields(message);
    std::iter::from_fn(move || {
        if fields.0.is_empty() {
            return None;
        }
        let field = fields.proto();
        if field.is_none() {
            fields.0 = &[];
        }
        Some(field)
    })
}

impl<'a> Fields<'a> {
    /// Encoding: <https://protobuf.dev/programming-guides/encoding/>. Groups (3, 4) are obsolete.
    fn proto(&mut self) -> Option<(u64, Proto<'a>)> {
        let key = self.varint()?;
        let value = match key & 7 {
            0 => Proto::Varint(self.varint()?),
            1 => Proto::Fixed64(self.u64()?),
            2 => {
                let count = self.varint()?;
                Proto::Bytes(self.bytes(count)?)
            }
            5 => Proto::Fixed32(self.u32()?),
            _ => return None,
        };
        Some((key >> 3, value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn protobuf_fields_are_read_up_to_the_first_malformed_one() {
        let message = [0x08, 0x96, 0x01, 0x12, 0x02, b'h', b'i', 0x1d, 1, 0, 0, 0, 0x21, 2, 0, 0, 0, 0, 0, 0, 0];
        let read: Vec<_> = protobuf(&message).collect();
        let expected =
            [(1, Proto::Varint(150)), (2, Proto::Bytes(b"hi")), (3, Proto::Fixed32(1)), (4, Proto::Fixed64(2))];
        assert_eq!(read, expected);
        for cut in 0..message.len() {
            assert!(protobuf(&message[..cut]).count() < 4);
            let whole = whole_protobuf(&message[..cut]).all(|field| field.is_some());
            assert_eq!(whole, [0, 3, 7, 12].contains(&cut), "cut at {cut}");
        }
        assert_eq!(protobuf(&[0x0a, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x01]).count(), 0);
        assert_eq!(protobuf(&[0xff; 20]).count(), 0);
    }
}
