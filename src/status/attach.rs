//! The link to an attached screen: snapshots of a run as lines of JSON, and what a screen of another process sends back.
//!
//! The run sends a [`Message`] per line. The first is [`Message::Hello`]; then come snapshots, whose log contains only the
//! lines that were not sent before, and previews, each followed by its bytes. The screen sends a [`Command`](super::Command)
//! per line.
//!
//! Invariant: a snapshot that was not sent takes no line of the log with it: a slow reader gets fewer snapshots, and all
//! lines that the board still has.
//! Invariant: what a peer sends is bounded by [`LONGEST_MESSAGE`] and [`LARGEST_PREVIEW`].

use std::collections::VecDeque;
use std::io::{self, BufRead, Read};
use std::sync::Arc;

use rapid_core::text::unanswered;
use serde::{Deserialize, Serialize};

use super::preview::{LARGEST_PREVIEW, Preview};
use super::{LogLine, Snapshot};

/// Changes when the messages do.
pub const PROTOCOL: u32 = 1;
/// The line with which a screen asks to be attached; the second does not accept commands.
pub const ATTACH: [&str; 2] = ["attach", "attach read-only"];
/// Longest message without its preview, in bytes: 64 devices, a session and the whole log are a tenth of it.
pub const LONGEST_MESSAGE: u64 = 8 << 20;
/// Lines of the log that a screen keeps.
const LOG_LINES: usize = 2000;

/// What a run sends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "message", content = "of", rename_all = "snake_case")]
pub enum Message {
    /// The first message.
    Hello {
        /// [`PROTOCOL`] of the run.
        protocol: u32,
        /// Version of the run's program.
        version: String,
        /// Its process.
        process: u32,
    },
    /// The state of everything; its log has only new lines.
    Snapshot(Box<Snapshot>),
    /// The newest sample of a device that is looked at; as many bytes as it names follow the line.
    Preview(Preview),
}

/// The run's side: turns snapshots into bytes.
#[derive(Debug, Default)]
pub struct Encoder {
    /// Number of the next line of the log that was not sent.
    next_line: u64,
    /// Of each preview sent, its device and sequence number.
    previews: Vec<(rapid_core::modality::ModalityId, u64)>,
}

impl Encoder {
    /// The first bytes of a link.
    pub fn hello(version: &str, process: u32) -> Vec<u8> {
        line(&Message::Hello { protocol: PROTOCOL, version: version.to_owned(), process })
    }

    /// The bytes for a snapshot, with its previews if they are new.
    pub fn encode(&mut self, mut snapshot: Snapshot) -> Vec<u8> {
        snapshot.log.retain(|line| line.number >= self.next_line);
        if let Some(last) = snapshot.log.last() {
            self.next_line = last.number + 1;
        }
        let previews = std::mem::take(&mut snapshot.previews);
        let mut bytes = line(&Message::Snapshot(Box::new(snapshot)));
        for preview in previews {
            let sent = self.previews.iter_mut().find(|(device, _)| *device == preview.device);
            let is_new = sent.as_ref().is_none_or(|(_, seq)| *seq != preview.seq);
            match sent {
                Some((_, seq)) => *seq = preview.seq,
                None => self.previews.push((preview.device, preview.seq)),
            }
            if is_new {
                bytes.extend(line(&Message::Preview(Preview::clone(&preview))));
                bytes.extend_from_slice(&preview.payload);
            }
        }
        bytes
    }
}

fn line(message: &Message) -> Vec<u8> {
    // Its types have no maps with keys that are not text, the only thing that JSON refuses.
    let mut bytes = serde_json::to_vec(message).unwrap_or_default();
    bytes.push(b'\n');
    bytes
}

/// Why a link ended.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The run has ended, or the link to it has.
    #[error("the run has ended")]
    Ended,
    /// The link cannot be read.
    #[error("{}", unanswered(.0))]
    Io(#[from] io::Error),
    /// Another version of the program sends other messages.
    #[error("the run uses another version of rapid ({0}): use the same version here")]
    Version(String),
    /// The run refused.
    #[error("the run refuses: {0}")]
    Refused(String),
}

/// The screen's side: puts snapshots together again.
#[derive(Debug, Default)]
pub struct Decoder {
    log: VecDeque<Arc<LogLine>>,
    previews: Vec<Arc<Preview>>,
}

impl Decoder {
    /// Reads messages until a snapshot is complete. Previews that follow it belong to the next one.
    ///
    /// # Errors
    /// When the link has ended, or the run speaks another protocol.
    pub fn read(&mut self, from: &mut impl BufRead) -> Result<Snapshot, LinkError> {
        loop {
            let mut text = String::new();
            from.take(LONGEST_MESSAGE).read_line(&mut text)?;
            if !text.ends_with('\n') {
                return Err(LinkError::Ended);
            }
            let message = serde_json::from_str(&text).map_err(|error| {
                let is_object = text.starts_with('{');
                let refused = || LinkError::Refused(text.trim_end().to_owned());
                if is_object { LinkError::Version(error.to_string()) } else { refused() }
            })?;
            match message {
                Message::Hello { protocol: PROTOCOL, .. } => {}
                Message::Hello { version, .. } => return Err(LinkError::Version(version)),
                Message::Snapshot(snapshot) => return Ok(self.complete(*snapshot)),
                Message::Preview(preview) => self.read_preview(preview, from)?,
            }
        }
    }

    fn complete(&mut self, mut snapshot: Snapshot) -> Snapshot {
        self.log.extend(std::mem::take(&mut snapshot.log));
        self.log.drain(..self.log.len().saturating_sub(LOG_LINES));
        snapshot.log = self.log.iter().cloned().collect();
        snapshot.previews.clone_from(&self.previews);
        snapshot
    }

    fn read_preview(&mut self, mut preview: Preview, from: &mut impl Read) -> Result<(), LinkError> {
        if preview.bytes > LARGEST_PREVIEW {
            return Err(LinkError::Version(format!("a preview of {} bytes", preview.bytes)));
        }
        let mut payload = vec![0; preview.bytes];
        from.read_exact(&mut payload)?;
        preview.payload = payload.into();
        self.previews.retain(|known| known.device != preview.device);
        self.previews.push(Arc::new(preview));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use rapid_core::sample::Encoding;

    use super::super::{DeviceState, Level};
    use super::*;
    use crate::literal::{device, every_state, line, policy, recording, snapshot};

    fn preview(bit: u8, seq: u64) -> Arc<Preview> {
        let device = crate::literal::id(bit);
        let payload: Arc<[u8]> = b"line\n{\"message\"\n".as_slice().into();
        Arc::new(Preview {
            device,
            seq,
            encoding: Encoding::F64,
            bytes: payload.len(),
            payload,
            ..crate::literal::preview()
        })
    }

    #[test]
    fn a_screen_sees_what_the_run_shows_and_every_line_of_the_log_once() {
        let mut first = every_state();
        first.recording = Some(recording(3));
        first.policy = Some(policy());
        first.previews = vec![preview(0, 5)];
        let mut second = first.clone();
        second.log.push(line(9, Level::Info, "new"));
        second.previews = vec![preview(0, 6), preview(3, 1)];
        let mut encoder = Encoder::default();
        let sent = [Encoder::hello("1", 2), encoder.encode(first.clone()), encoder.encode(second.clone())].concat();
        let third = encoder.encode(second.clone());
        assert!(!String::from_utf8_lossy(&third).contains("\"text\""), "nothing is sent twice");
        let mut link = Cursor::new([sent, third].concat());
        let mut decoder = Decoder::default();
        let mut expected = first.clone();
        expected.previews.clear();
        assert_eq!(decoder.read(&mut link).unwrap(), expected);
        let mut expected = second.clone();
        expected.previews = first.previews;
        assert_eq!(decoder.read(&mut link).unwrap(), expected);
        assert_eq!(decoder.read(&mut link).unwrap(), second);
        assert!(matches!(decoder.read(&mut link), Err(LinkError::Ended)));
    }

    #[test]
    fn numbers_that_json_does_not_have_reach_the_screen() {
        let mut odd = snapshot(vec![device(0, "a", DeviceState::Streaming, "")]);
        let mut policy = policy();
        policy.action[0].1 = f64::NAN;
        odd.policy = Some(policy);
        let read = Decoder::default().read(&mut Cursor::new(Encoder::default().encode(odd))).unwrap();
        assert!(read.policy.unwrap().action[0].1.is_nan());
    }

    #[test]
    fn what_is_no_link_is_an_error() {
        for (bytes, word) in [
            (&b""[..], "ended"),
            (b"{\"message\":\"hello\",\"of\":{\"protocol\":77,\"version\":\"9\",\"process\":1}}\n", "another version"),
            (b"{\"message\":\"other\"}\n", "another version"),
            (b"not an order: write `arm NS`\n", "refuses: not an order"),
            (b"{\"message\":\"preview\",\"of\":{\"device\":64}}\n", "another version"),
        ] {
            let error = Decoder::default().read(&mut Cursor::new(bytes)).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
