//! What waits for a client that reads slowly, by topic.
//!
//! Invariant: of a topic that a client subscribes to, no more than [`TOPIC_BYTES`] wait for it, or one message that is
//! larger; the oldest are left out. So a picture of half of that or more waits alone until a newer one replaces it, and a
//! topic of small messages is complete unless its client stays behind for as long as these take to be as many.
//! Invariant: what is not a message of a topic (channels, answers of services) is never left out: a client that leaves more
//! than [`OTHER_BYTES`] of it unread has to be disconnected, and so has one for which more than [`CLIENT_BYTES`] wait
//! altogether.

use std::collections::{BTreeMap, VecDeque};

use tokio_tungstenite::tungstenite::Message;

/// What waits of one topic for one client: three seconds of the mask, the newest picture of most cameras.
const TOPIC_BYTES: usize = 64 << 10;
/// What waits for one client that belongs to no topic, with [`MESSAGE_COST`]: several times all channels of the largest rig.
const OTHER_BYTES: usize = 8 << 20;
/// What waits for one client altogether, with [`MESSAGE_COST`]: a picture of each of many cameras.
pub(super) const CLIENT_BYTES: usize = 64 << 20;
/// What a message that waits costs beyond its bytes, at most: its places in the queues, and the allocator's own.
const MESSAGE_COST: usize = 256;

/// The number that a client gave to its subscription of a topic, of a message of it. `None` is every other message.
pub(super) type Topic = Option<u32>;

/// Why a client has to be disconnected.
pub(super) type Excess = &'static str;

/// What waits for a client.
#[derive(Debug, Default)]
pub(super) struct Waiting {
    topics: BTreeMap<Topic, Track>,
    /// Bytes of all messages, each with [`MESSAGE_COST`].
    pub(super) cost: usize,
    /// Messages that have come.
    count: u64,
    /// Messages that were left out, and not reported yet.
    pub(super) left_out: u64,
}

/// Of one topic: bytes, and messages with their numbers, the oldest first; never empty.
#[derive(Debug, Default)]
struct Track {
    bytes: usize,
    messages: VecDeque<(u64, Message)>,
}

impl Waiting {
    /// Adds a message, and leaves out older ones of its topic that are too much with it.
    ///
    /// # Errors
    /// When there is too much that is never left out, or too much altogether. The client has to be disconnected then.
    pub(super) fn push(&mut self, topic: Topic, message: Message) -> Result<(), Excess> {
        let track = self.topics.entry(topic).or_default();
        while topic.is_some() && track.bytes + message.len() > TOPIC_BYTES {
            let Some((_, oldest)) = track.messages.pop_front() else { break };
            track.bytes -= oldest.len();
            self.cost -= oldest.len() + MESSAGE_COST;
            self.left_out += 1;
        }
        track.bytes += message.len();
        self.cost += message.len() + MESSAGE_COST;
        track.messages.push_back((self.count, message));
        self.count += 1;
        if topic.is_none() && track.bytes + track.messages.len() * MESSAGE_COST > OTHER_BYTES {
            return Err("it sends requests and does not read the answers");
        }
        if self.cost > CLIENT_BYTES {
            return Err("it subscribes to more than it reads");
        }
        Ok(())
    }

    /// Forgets the messages of a topic: its client does not subscribe to it any more.
    pub(super) fn forget(&mut self, topic: u32) {
        if let Some(track) = self.topics.remove(&Some(topic)) {
            self.cost -= track.bytes + track.messages.len() * MESSAGE_COST;
        }
    }

    /// Takes the oldest message.
    pub(super) fn pop(&mut self) -> Option<Message> {
        let oldest = |(topic, track): (&Topic, &Track)| Some((track.messages.front()?.0, *topic));
        let (_, topic) = self.topics.iter().filter_map(oldest).min()?;
        let track = self.topics.get_mut(&topic)?;
        let (_, message) = track.messages.pop_front()?;
        track.bytes -= message.len();
        self.cost -= message.len() + MESSAGE_COST;
        if track.messages.is_empty() {
            self.topics.remove(&topic);
        }
        Some(message)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A message of this topic, or of none, with this content.
    fn message_of(topic: Topic, content: &[u8]) -> Message {
        match topic {
            Some(topic) => Message::binary([&[1][..], &topic.to_le_bytes(), &[0; 8], content].concat()),
            None => Message::binary(content.to_vec()),
        }
    }

    #[test]
    fn the_newest_picture_waits_and_every_small_message() {
        let mut waiting = Waiting::default();
        let (mut expected, mut left_out) = (Vec::new(), 0);
        for number in 0_u32..1000 {
            let small = message_of(Some(1), &number.to_le_bytes());
            let other = message_of(None, &number.to_le_bytes());
            for (topic, message) in [(Some(1), &small), (None, &other)] {
                waiting.push(topic, message.clone()).unwrap();
                expected.push(message.clone());
            }
            for camera in [2, 3] {
                let picture = message_of(Some(camera), &number.to_le_bytes().repeat(10_000));
                waiting.push(Some(camera), picture.clone()).unwrap();
                if number == 999 {
                    expected.push(picture);
                } else {
                    left_out += 1;
                }
            }
        }
        assert_eq!(waiting.left_out, left_out);
        let popped: Vec<_> = std::iter::from_fn(|| waiting.pop()).collect();
        assert!(popped == expected, "{} messages", popped.len());
        assert!(waiting.topics.is_empty() && waiting.cost == 0);
    }

    #[test]
    fn what_waits_is_bounded() {
        let mut waiting = Waiting::default();
        let message = message_of(Some(1), &[0; 1000]);
        let most = TOPIC_BYTES / message.len();
        for _ in 0..3 * most {
            waiting.push(Some(1), message.clone()).unwrap();
        }
        assert_eq!(std::iter::from_fn(|| waiting.pop()).count(), most);
        let answer = message_of(None, &vec![0; 1 << 20]);
        let fits = (0..100).take_while(|_| waiting.push(None, answer.clone()).is_ok()).count();
        assert_eq!(fits, OTHER_BYTES / ((1 << 20) + MESSAGE_COST), "their places count too");
    }

    #[test]
    fn neither_many_subscriptions_nor_tiny_messages_get_around_the_limits() {
        let fits = |messages: &mut dyn Iterator<Item = (Topic, Message)>| {
            let mut waiting = Waiting::default();
            messages.take_while(|(topic, message)| waiting.push(*topic, message.clone()).is_ok()).count()
        };
        let picture = message_of(Some(0), &vec![0; 200_000]);
        let pictures = fits(&mut (0..10_000).map(|id| (Some(id), picture.clone())));
        assert_eq!(pictures, CLIENT_BYTES / (picture.len() + MESSAGE_COST));
        let message = message_of(Some(0), &[]);
        let messages = fits(&mut (0..1_000_000).map(|id| (Some(id), message.clone())));
        assert_eq!(messages, CLIENT_BYTES / (message.len() + MESSAGE_COST));
        let pongs = fits(&mut std::iter::repeat_n((None, Message::text("")), 1_000_000));
        assert_eq!(pongs, OTHER_BYTES / MESSAGE_COST);
    }
}
