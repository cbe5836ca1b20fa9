//! The attachments `reference/KEY`: the sample that a policy compares all later ones of its observation KEY with, or that stands
//! for them. The episode may have begun after it. The data are the bytes of a message on the sample's topic; the media type
//! names its schema.

use mcap::Attachment;
use rapid_core::sample::SampleHeader;

use super::decode::{self, Content, Kind, Scratch};
use super::encode;
use super::schema::SampleSchema;

const PREFIX: &str = "reference/";
const MEDIA: &str = "application/protobuf; messageType=";

/// The sample that a policy compares all later ones of an observation with, or that stands for them.
#[derive(Debug, Clone)]
pub struct ReferenceSample {
    /// Key of the observation.
    pub observation: String,
    /// Name of the modality.
    pub modality: String,
    /// As received.
    pub header: SampleHeader,
    /// As the device sent it.
    pub payload: Vec<u8>,
}

/// The attachment of a sample that was captured at `wall_ns`. `message` is memory for it.
pub(crate) fn attachment<'a>(message: &'a mut Vec<u8>, wall_ns: u64, sample: &ReferenceSample) -> Attachment<'a> {
    let ReferenceSample { observation, modality, header, payload } = sample;
    let schema = SampleSchema::for_sample(header, payload);
    encode::sample(message, schema, wall_ns, modality, header, payload);
    Attachment {
        log_time: wall_ns,
        create_time: wall_ns,
        name: format!("{PREFIX}{observation}"),
        media_type: format!("{MEDIA}{}", schema.schema().name),
        data: message.as_slice().into(),
    }
}

/// The key of the observation; `None` if this is another attachment.
pub fn observation<'a>(attachment: &'a Attachment<'_>) -> Option<&'a str> {
    attachment.name.strip_prefix(PREFIX)
}

/// The sample as far as its message contains it; `None` if it cannot be read.
pub fn sample(attachment: &Attachment<'_>) -> Option<(SampleHeader, Vec<u8>)> {
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
    Some((header, sample.payload.to_vec()))
}

#[cfg(test)]
mod tests {
    use rapid_core::sample::Encoding;

    use super::*;

    #[test]
    fn what_is_attached_is_read_again_and_nothing_else() {
        let pixels: Vec<u8> = (0..12).collect();
        let numbers = [1.5_f64, -2.0].map(f64::to_le_bytes).concat();
        for (encoding, width, height, payload) in
            [(Encoding::Grey, 4, 3, pixels), (Encoding::F64, 2, 0, numbers), (Encoding::Bytes, 0, 0, b"any".to_vec())]
        {
            let header = SampleHeader { encoding: encoding as u32, width, height, ..SampleHeader::default() };
            let mut message = Vec::new();
            let (observation_key, modality) = ("touch".to_owned(), "tip".to_owned());
            let reference =
                ReferenceSample { observation: observation_key, modality, header, payload: payload.clone() };
            let mut attached = attachment(&mut message, 77, &reference);
            let (read_header, read_payload) = sample(&attached).unwrap();
            assert_eq!((observation(&attached), read_payload), (Some("touch"), payload));
            assert_eq!((read_header.encoding, read_header.capture_ns), (encoding as u32, 77));
            if header.height > 0 {
                assert_eq!((read_header.width, read_header.height), (width, height));
            }
            let whole = attached.data.clone();
            for cut in 1..whole.len() {
                // Any bytes: an error or another sample, no panic.
                attached.data = whole[..cut].to_vec().into();
                let _ = sample(&attached);
            }
            attached.data = whole;
            attached.media_type = "application/protobuf; messageType=another".to_owned();
            assert!(sample(&attached).is_none());
            attached.name = "devices.toml".to_owned();
            assert!(observation(&attached).is_none());
        }
    }
}
