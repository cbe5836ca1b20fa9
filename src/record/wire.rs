//! Reading untrusted bytes: MCAP's fields and protobuf's.
//!
//! Invariant: no bytes make anything here panic, or allocate more than they are long.

use std::collections::BTreeMap;

/// Bytes still to be read. Each method takes what it returns off the front; `None` when the bytes
/// do not hold it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fields<'a>(pub(super) &'a [u8]);

impl<'a> Fields<'a> {
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*head)
    }

    pub(super) fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub(super) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub(super) fn bytes(&mut self, count: u64) -> Option<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(usize::try_from(count).ok()?)?;
        self.0 = rest;
        Some(head)
    }

    /// MCAP's string: a u32 count of bytes before it.
    pub(super) fn string(&mut self) -> Option<&'a str> {
        let count = self.u32()?;
        std::str::from_utf8(self.bytes(count.into())?).ok()
    }

    /// MCAP's map of strings: a u32 count of bytes before it.
    pub(super) fn map(&mut self) -> Option<BTreeMap<String, String>> {
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
pub(super) enum Proto<'a> {
    /// Varint, or fixed 64 or 32 bits: the bits.
    Number(u64),
    /// Bytes, text or a message.
    Bytes(&'a [u8]),
}

impl<'a> Proto<'a> {
    pub(super) fn number(self) -> u64 {
        match self {
            Self::Number(number) => number,
            Self::Bytes(_) => 0,
        }
    }

    /// A `sint64`.
    pub(super) fn zigzag(self) -> i64 {
        let number = self.number();
        (number >> 1).cast_signed() ^ -(number & 1).cast_signed()
    }

    pub(super) fn bytes(self) -> &'a [u8] {
        match self {
            Self::Number(_) => &[],
            Self::Bytes(bytes) => bytes,
        }
    }

    pub(super) fn text(self) -> String {
        String::from_utf8_lossy(self.bytes()).into_owned()
    }
}

/// The fields of a protobuf message, until its end or the first byte that makes no sense.
pub(super) fn protobuf(message: &[u8]) -> impl Iterator<Item = (u64, Proto<'_>)> {
    let mut fields = Fields(message);
    std::iter::from_fn(move || {
        let key = fields.varint()?;
        let value = match key & 7 {
            0 => Proto::Number(fields.varint()?),
            1 => Proto::Number(fields.u64()?),
            2 => {
                let count = fields.varint()?;
                Proto::Bytes(fields.bytes(count)?)
            }
            5 => Proto::Number(fields.u32()?.into()),
            _ => return None,
        };
        Some((key >> 3, value))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn protobuf_fields_are_read_until_they_make_no_sense() {
        let message = [0x08, 0x96, 0x01, 0x12, 0x02, b'h', b'i', 0x1d, 1, 0, 0, 0, 0x21, 2, 0, 0, 0, 0, 0, 0, 0];
        let read: Vec<_> = protobuf(&message).collect();
        let expected =
            [(1, Proto::Number(150)), (2, Proto::Bytes(b"hi")), (3, Proto::Number(1)), (4, Proto::Number(2))];
        assert_eq!(read, expected);
        for cut in 0..message.len() {
            assert!(protobuf(&message[..cut]).count() < 4);
        }
        assert_eq!(protobuf(&[0x0a, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x01]).count(), 0);
        assert_eq!(protobuf(&[0xff; 20]).count(), 0);
    }
}
