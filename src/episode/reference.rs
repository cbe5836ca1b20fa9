//! The attachments `reference/KEY`: the sample from before the episode that a policy compares all later ones of its observation
//! KEY with. The data are the message that the topic of the sample would have; the media type names its schema.

use mcap::Attachment;

use super::decode::{self, Content, Kind, Scratch};
use super::encode;
use super::schema::SampleSchema;
use crate::sample::SampleHeader;

const PREFIX: &str = "reference/";
const MEDIA: &str = "application/protobuf; messageType=";

/// The attachment of a sample of `device`, captured at `wall_ns`. `message` is memory for it.
pub(crate) fn attachment<'a>(
    message: &'a mut Vec<u8>,
    observation: &str,
    device: &str,
    wall_ns: u64,
    (header, payload): (&SampleHeader, &[u8]),
) -> Attachment<'a> {
    let schema = SampleSchema::of(header, payload);
    encode::sample(message, schema, wall_ns, device, header, payload);
    Attachment {
        log_time: wall_ns,
        create_time: wall_ns,
        name: format!("{PREFIX}{observation}"),
        media_type: format!("{MEDIA}{}", schema.schema().name),
        data: message.as_slice().into(),
    }
}

/// The observation, and the sample as far as its message contains it; `None` if this is another attachment.
pub(crate) fn read(attachment: &Attachment<'_>) -> Option<(String, SampleHeader, Vec<u8>)> {
    let observation = attachment.name.strip_prefix(PREFIX)?;
    let schema = SampleSchema::named(attachment.media_type.strip_prefix(MEDIA)?)?;
    let mut scratch = Scratch::default();
    let Content::Sample(sample) = decode::content(Kind::Sample(schema), &attachment.data, &mut scratch)? else {
        return None;
    };
    let header = SampleHeader {
        capture_ns: attachment.log_time,
        encoding: sample.encoding as u32,
        width: sample.width,
        height: sample.height,
        ..SampleHeader::default()
    };
    Some((observation.to_owned(), header, sample.payload.to_vec()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample::Encoding;

    #[test]
    fn what_is_attached_is_read_again_and_nothing_else() {
        let pixels: Vec<u8> = (0..12).collect();
        let numbers = [1.5_f64, -2.0].map(f64::to_le_bytes).concat();
        for (encoding, width, height, payload) in
            [(Encoding::Grey, 4, 3, pixels), (Encoding::F64, 2, 0, numbers), (Encoding::Bytes, 0, 0, b"any".to_vec())]
        {
            let header = SampleHeader { encoding: encoding as u32, width, height, ..SampleHeader::default() };
            let mut message = Vec::new();
            let mut attached = attachment(&mut message, "touch", "tip", 77, (&header, &payload));
            let (observation, read_header, read_payload) = read(&attached).unwrap();
            assert_eq!((observation.as_str(), read_payload), ("touch", payload));
            assert_eq!((read_header.encoding, read_header.capture_ns), (encoding as u32, 77));
            if header.height > 0 {
                assert_eq!((read_header.width, read_header.height), (width, height));
            }
            let whole = attached.data.clone();
            for cut in 1..whole.len() {
                // Any bytes: an error or another sample, no panic.
                attached.data = whole[..cut].to_vec().into();
                let _ = read(&attached);
            }
            attached.data = whole;
            attached.media_type = "application/protobuf; messageType=another".to_owned();
            assert!(read(&attached).is_none());
            attached.name = "devices.toml".to_owned();
            assert!(read(&attached).is_none());
        }
    }
}
