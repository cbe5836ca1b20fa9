//! How intact a file is, as found while reading it.

use rapid_core::text;

use super::episode_id::EpisodeId;
use super::wire::Fields;

/// How a file ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FileEnd {
    /// With its footer: the recorder finished it.
    Finished,
    /// Between two records: the recorder was ended early, or is still writing.
    #[default]
    Unfinished,
    /// Within a record: the last write was cut in two.
    Torn,
    /// At something that is not a record; anything after it is unknown.
    Damaged,
}

/// Parts of a file that are left out because they cannot be read or proven.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct LeftOut {
    /// Places that could not be read. Reading continued after them with the next valid record.
    pub gaps: u64,
    /// Records larger than 256 MiB.
    pub oversized_records: u64,
    /// Chunks that would decompress to more than is allowed for a file of this size.
    pub swollen_chunks: u64,
    /// Definitions of channels and metadata beyond 8 MiB, channels beyond 4096, and metadata within a chunk.
    pub excess_records: u64,
    /// Repeated chunks.
    pub repeated_chunks: u64,
    /// Messages of valid chunks whose channel is not defined in the file.
    pub nameless_messages: u64,
    /// Whole but unproven messages of a chunk cut by the end of the file.
    pub unproven_messages: u64,
    /// Bytes of that chunk.
    pub unproven_bytes: u64,
    /// Chunks of another episode.
    pub other_chunks: u64,
    /// Bytes before the beginning of the file: an archive's, or a mail's.
    pub bytes_before: u64,
    /// Bytes after the end of a finished file, of another file or of none.
    pub bytes_behind: u64,
}

impl LeftOut {
    /// The parts with their amounts, for people; `damaged_chunks` included.
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

/// How intact a file is, as far as it has been read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Integrity {
    /// How the file ends.
    pub end: FileEnd,
    /// Bytes understood.
    pub bytes: u64,
    /// Chunks with a wrong check value; nothing of them is shown.
    pub damaged_chunks: u64,
    /// Other parts left out.
    pub left_out: LeftOut,
    /// Whole messages of a chunk cut by the end of the file, shown without a check value: the kernel that was running
    /// when they were written still runs, and has kept their order.
    pub ordered_messages: u64,
    /// The file is whole: finished, nothing after its end, every check value right, nothing left out.
    pub sound: bool,
    /// It is whole, and no check value is zero, the format's value for "not computed".
    pub proven: bool,
    /// Which program wrote it.
    pub writer: Writer,
    /// Its end gives the place of its index.
    pub indexed: bool,
    /// The episode that its chunks name.
    pub episode: Option<EpisodeId>,
}

impl Integrity {
    /// The bytes of `size` that were not understood, without foreign bytes before and after the file.
    pub(crate) fn unread(&self, size: u64) -> u64 {
        let LeftOut { bytes_before, bytes_behind, .. } = self.left_out;
        [self.bytes, bytes_before, bytes_behind].into_iter().fold(size, u64::saturating_sub)
    }

    /// The unreadable parts of the file, for people; `None` if there are none.
    pub fn damage(&self) -> Option<String> {
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
pub enum Writer {
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
    // A name overwritten with zeros is not a name.
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
