//! The header of an MCAP file: which program wrote it.
//!
//! Format: <https://mcap.dev/spec#header-op0x01>.

use super::wire::Fields;

/// Begins the name of the library in the header of a file that this program wrote.
const LIBRARY: &str = "rapid/";
/// Longest header that is read, bytes: ours has under 50.
pub(super) const LARGEST: u64 = 4 << 10;

/// Which program wrote a file, as its header says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Writer {
    /// This one.
    Rapid,
    /// Another, which has put a profile or its name there.
    Another,
    /// The header cannot be read, or names none.
    Unknown,
}

/// Which program wrote the file with this header.
pub(super) fn writer(header: &[u8]) -> Writer {
    let mut fields = Fields(header);
    let Some((profile, library)) = fields.string().zip(fields.string()) else { return Writer::Unknown };
    if library.starts_with(LIBRARY) {
        return Writer::Rapid;
    }
    // A name that was overwritten with zeros is none.
    let is_text = !profile.chars().chain(library.chars()).any(char::is_control);
    if is_text && !(profile.is_empty() && library.is_empty()) { Writer::Another } else { Writer::Unknown }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_names_the_program_that_wrote_it() {
        let header = |profile: &str, library: &str| {
            let text = |text: &str| [&u32::try_from(text.len()).unwrap().to_le_bytes(), text.as_bytes()].concat();
            writer(&[text(profile), text(library)].concat())
        };
        for (profile, library, expected) in [
            ("", "rapid/0.1.0", Writer::Rapid),
            ("", "mcap go v1.7", Writer::Another),
            ("ros2", "", Writer::Another),
            ("", "", Writer::Unknown),
            ("", "rap\0\0\0\0\0\0\0\0", Writer::Unknown),
        ] {
            assert_eq!(header(profile, library), expected, "{profile:?} {library:?}");
        }
        assert_eq!(writer(&[0, 0, 0]), Writer::Unknown);
    }
}
