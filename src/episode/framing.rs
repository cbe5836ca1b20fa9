//! How a file and its records are framed: <https://mcap.dev/spec#file-structure>.

/// At the beginning of a file and at its end.
pub const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Largest record that is read: a greater length counts as damaged. A 4K raw picture has 16 MiB.
pub(crate) const MAX_RECORD: u64 = 256 << 20;
/// An opcode, and the length of what follows as u64.
pub(super) const HEAD: u64 = 9;
