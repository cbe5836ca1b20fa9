//! The few fields of a JPEG picture that are parsed (ITU-T T.81, annex B).

/// Start of image.
pub(super) const START: [u8; 2] = [0xff, 0xd8];

/// Width and height in pixels; `None` if the first segments do not contain them.
pub(super) fn size(picture: &[u8]) -> Option<(u32, u32)> {
    /// More segments than any camera writes before the image data.
    const SEGMENTS: usize = 64;
    let mut rest = picture.strip_prefix(&START)?;
    for _ in 0..SEGMENTS {
        let [0xff, marker, after @ ..] = rest else { return None };
        let ([high, low], segment) = after.split_first_chunk::<2>()?;
        let length = usize::from(u16::from_be_bytes([*high, *low]));
        match marker {
            // Fill bytes before a marker.
            0xff => {
                rest = rest.get(1..)?;
                continue;
            }
            // Frame headers: all of C0..CF except the tables.
            0xc0..=0xcf if !matches!(marker, 0xc4 | 0xc8 | 0xcc) => {
                let [_, h1, h0, w1, w0, ..] = segment else { return None };
                return Some((u16::from_be_bytes([*w1, *w0]).into(), u16::from_be_bytes([*h1, *h0]).into()));
            }
            // The image data.
            0xda => return None,
            _ => {}
        }
        rest = after.get(length..)?;
    }
    None
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_frame_header_gives_the_size() {
        let comment = [0xff, 0xfe, 0, 4, b'h', b'i'];
        let frame = [0xff, 0xc0, 0, 17, 8, 1, 0xe0, 2, 0x80, 3];
        let tables = [0xff, 0xc4, 0, 3, 0];
        let picture = [&START[..], &comment, &tables, &[0xff], &frame].concat();
        assert_eq!(size(&picture), Some((640, 480)));
        assert_eq!(size(&picture[..picture.len() - 6]), None);
        assert_eq!(size(&[&START[..], &[0xff, 0xda, 0, 2]].concat()), None);
        assert_eq!(size(b"GIF89a"), None);
    }

    proptest! {
        #[test]
        fn any_bytes_are_survived(rest in prop::collection::vec(prop_oneof![Just(0xff_u8), any::<u8>()], 0..200)) {
            let _ = size(&[&START[..], &rest].concat());
        }
    }
}
