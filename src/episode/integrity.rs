//! How whole a file is: what reading it finds of the file itself.

use super::own::EpisodeId;
use super::wire::Fields;
use crate::text;

/// How a file ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FileEnd {
    /// With its footer: the recorder finished it.
    Finished,
    /// Between two records: the recorder was ended before it could finish, or is still writing.
    #[default]
    Unfinished,
    /// Within a record: the last write was cut in two.
    Torn,
    /// At something that is no record; what follows it is unknown.
    Damaged,
}

/// What of a file is left out because it cannot be read, or because nothing proves it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct LeftOut {
    /// Places at which the file could not be read. Reading continued behind them where anything right follows.
    pub gaps: u64,
    /// Records larger than 256 MiB.
    pub oversized_records: u64,
    /// Chunks that would decompress to more than is allowed for a file of this size.
    pub swollen_chunks: u64,
    /// Definitions of channels and metadata beyond 8 MiB, channels beyond 4096, and metadata within a chunk.
    pub excess_records: u64,
    /// Chunks that were there before.
    pub repeated_chunks: u64,
    /// Messages of right chunks whose channel nothing in the file defines.
    pub nameless_messages: u64,
    /// Whole messages of a chunk that the end of the file cuts, which nothing proves.
    pub unproven_messages: u64,
    /// Bytes of that chunk.
    pub unproven_bytes: u64,
    /// Chunks of another episode.
    pub other_chunks: u64,
    /// Bytes before the beginning of the file: an archive's, or a mail's.
    pub bytes_before: u64,
    /// Bytes behind the end of a finished file: they are another file's, or belong to none.
    pub bytes_behind: u64,
}

impl LeftOut {
    /// What it is and how much, for people, one part after the other; of `damaged_chunks` too.
    #[must_use]
    pub fn sentences(&self, damaged_chunks: u64) -> Vec<String> {
        let Self { gaps, oversized_records, swollen_chunks, excess_records, repeated_chunks, .. } = *self;
        let Self { nameless_messages, other_chunks, bytes_before, bytes_behind, .. } = *self;
        let report = [
            (damaged_chunks, "damaged chunk", "left out"),
            (gaps, "place", "not readable"),
            (oversized_records, "record", "left out: larger than 256 MiB"),
            (swollen_chunks, "chunk", "left out: too large when decompressed"),
            (excess_records, "record", "left out: too many definitions, or none where they belong"),
            (repeated_chunks, "chunk", "left out: a repetition"),
            (nameless_messages, "message", "left out: the definition of the channel is lost"),
            (other_chunks, "chunk", "left out: another episode's"),
            (bytes_before, "byte", "left out: before the beginning of the file"),
            (bytes_behind, "byte", "left out: behind the end of the file"),
        ];
        let report = report.into_iter().filter(|(count, ..)| *count > 0);
        let mut report: Vec<String> = report.map(|(count, what, why)| format!("{} {why}", is(count, what))).collect();
        if self.unproven_bytes > 0 {
            let messages = is(self.unproven_messages, "message");
            report.push(format!("{messages} left out: in a chunk that is cut, and nothing proves that they are whole"));
        }
        report
    }

    fn is_nothing(&self) -> bool {
        *self == Self::default()
    }
}

/// `1 place is`, `2,000 places are`.
fn is(count: u64, what: &str) -> String {
    format!("{} {}", text::counted(count, what), if count == 1 { "is" } else { "are" })
}

/// How whole a file is, as far as it has been read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Integrity {
    /// How the file ends.
    pub(crate) end: FileEnd,
    /// Bytes understood.
    pub(crate) bytes: u64,
    /// Chunks whose content is not what was written; nothing of them is shown.
    pub(crate) damaged_chunks: u64,
    /// What else is left out.
    pub(crate) left_out: LeftOut,
    /// Whole messages of a chunk that the end of the file cuts, shown although their check value is not there: the kernel
    /// that was running when they were written still is, and has kept their order.
    pub(crate) ordered_messages: u64,
    /// The file is whole: finished, nothing behind its end, every check value right, nothing left out.
    pub(crate) sound: bool,
    /// It is sound, and every check value is there: none is zero, which the format has for "not computed".
    pub(crate) proven: bool,
    /// Which program wrote it.
    pub(crate) writer: Writer,
    /// Its end states where its index lies.
    pub(crate) indexed: bool,
    /// The episode that its chunks name.
    pub(crate) episode: Option<EpisodeId>,
}

impl Integrity {
    /// Of the `size` bytes of the file those that were not understood. What stands before it and behind it is not its own.
    pub(crate) fn unread(&self, size: u64) -> u64 {
        let LeftOut { bytes_before, bytes_behind, .. } = self.left_out;
        [self.bytes, bytes_before, bytes_behind].into_iter().fold(size, u64::saturating_sub)
    }

    /// What of the file could not be read, for people; `None`: nothing.
    #[cfg(feature = "policy")]
    pub(crate) fn damage(&self) -> Option<String> {
        let end = match self.end {
            FileEnd::Finished => None,
            FileEnd::Unfinished => Some("the file was not finished".to_owned()),
            FileEnd::Torn => Some("the file ends within a record".to_owned()),
            FileEnd::Damaged => Some(format!("the file is damaged after {} bytes", self.bytes)),
        };
        let parts: Vec<String> = end.into_iter().chain(self.left_out.sentences(self.damaged_chunks)).collect();
        (!parts.is_empty()).then(|| format!("{}; what could be read is used", parts.join(", ")))
    }

    /// Is nothing left out but, perhaps, less than one record at a torn end?
    pub(crate) fn is_all(&self) -> bool {
        self.sound || self.end != FileEnd::Damaged && self.damaged_chunks == 0 && self.left_out.is_nothing()
    }
}

/// A record that is not one of the container's own.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Record<'a> {
    pub(crate) opcode: u8,
    pub(crate) data: &'a [u8],
}

/// Begins the name of the library in the header of a file that this program wrote.
const LIBRARY: &str = "rapid/";
/// Longest header that is read, bytes: ours has under 50.
pub(super) const LARGEST_HEADER: u64 = 4 << 10;

/// Which program wrote a file, by its header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Writer {
    /// This one.
    Rapid,
    /// Another, which has put a profile or its name there.
    Another,
    /// The header cannot be read, or names none.
    #[default]
    Unknown,
}

/// Which program wrote the file with this header. Format: <https://mcap.dev/spec#header-op0x01>.
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
