//! Does a payload look like one whole JPEG picture? Not a decoder: two bytes at each end.

/// Start of image and end of image (ITU-T T.81, table B.1).
const SOI: [u8; 2] = [0xff, 0xd8];
const EOI: [u8; 2] = [0xff, 0xd9];

/// Does it begin and end as a picture does? Some cameras fill a picture up with zeros: those do not
/// count.
pub(super) fn is_whole(payload: &[u8]) -> bool {
    let end = payload.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
    let picture = payload.get(..end).unwrap_or_default();
    // Both markers, each with bytes of its own.
    picture.len() >= 4 && picture.starts_with(&SOI) && picture.ends_with(&EOI)
}
