//! Synchronisation of a running rig: at each tick of the observation grid, which sample of each modality belongs to it.
//!
//! It is published on [`OBSERVATION_TOPIC`](rapid_core::observation::OBSERVATION_TOPIC), so that no other program has to align
//! samples. An observation holds what was known at its tick, as a policy sees it; the frames of an episode are made a
//! tenth of a second later, and also know samples that were in transit.
//!
//! Invariant: nothing here blocks: the samples that wait on the bus are looked at when a tick is due. After the first
//! ticks nothing allocates, except for a modality that is added.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use rapid_bus::{BusError, Queues, Subscription, TopicId, Writer};
use rapid_core::mask::Bits;
use rapid_core::modality::ModalityId;
use rapid_core::observation::{HEAD_BYTES, SLOT_BYTES};
use rapid_core::sample::{Encoding, Epoch, FLAG_ERROR, SampleHeader};
use rapid_core::sync::{Grid, SyncModality, SyncSample, Synchronizer};
use rapid_core::time::Stamp;
use rapid_core::walked::WalkedPictures;
use rapid_pictures::judge::PictureJudge;
use rapid_registry::{DeviceSpec, Registry};
use rapid_status::Board;
use tokio::sync::mpsc;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

/// Changes of the mask that are remembered between two ticks.
const MASKS: usize = 64;

/// Samples of a modality that may arrive between a tick and the look at the bus, and must not displace an older one that
/// belongs to it.
const SLACK: usize = 16;

/// See the module's comment.
#[derive(Debug)]
pub struct Alignment {
    aligner: Aligner,
    hz: f64,
    queues: Queues,
    writer: Arc<Writer>,
    /// Receives the samples that screens look at: no other subscriber is needed for them.
    board: Arc<Board>,
    additions: mpsc::UnboundedReceiver<(Arc<DeviceSpec>, Subscription)>,
}

impl Alignment {
    /// Of the samples that reach `queues` from now on; `writer` is that of the topic of observations.
    pub fn new(registry: &Registry, queues: Queues, writer: Arc<Writer>, board: Arc<Board>) -> Self {
        let (aligner, hz) = (Aligner::new(registry, board.walked()), registry.rig.observation_hz);
        Self { aligner, hz, queues, writer, board, additions: mpsc::unbounded_channel().1 }
    }

    /// Also of the modalities that are added during its run.
    #[must_use]
    pub fn extended_by(self, additions: mpsc::UnboundedReceiver<(Arc<DeviceSpec>, Subscription)>) -> Self {
        Self { additions, ..self }
    }

    /// Publishes an observation at each tick until `stop`. Ticks that pass while the machine is suspended, or too slow
    /// for their rate, are skipped, and so are some above 200 Hz: the timer has a resolution of 1 ms. The number of a
    /// tick is the sequence number of its observation. Returns how many were published.
    pub async fn run(mut self, stop: CancellationToken) -> u64 {
        let grid = Grid::new(Stamp::now(), self.hz);
        let (mut next, mut published) = (0, 0);
        let mut is_reported = false;
        loop {
            tokio::select! {
                biased;
                () = stop.cancelled() => return published,
                Some((device, subscription)) = self.additions.recv() => {
                    self.queues.add(subscription);
                    self.aligner.add(&device);
                    continue;
                }
                () = sleep(grid.tick(next).since(Stamp::now())) => {}
            }
            let now = Stamp::now();
            let due = grid.ticks_before(now.after(Duration::from_nanos(1)));
            let number = next.max(due.saturating_sub(1));
            match self.publish(number, grid.tick(number), now) {
                Ok(()) => published += 1,
                Err(error) if !std::mem::replace(&mut is_reported, true) => {
                    tracing::warn!(%error, "an observation is not published");
                }
                Err(_) => {}
            }
            next = number + 1;
        }
    }

    fn publish(&mut self, number: u64, tick: Stamp, now: Stamp) -> Result<(), BusError> {
        let Self { aligner, queues, writer, board, .. } = self;
        queues.drain(&mut |topic, header, payload| {
            aligner.receive(topic, header, payload);
            if let TopicId::Modality(id) = topic {
                board.preview(id, header, payload);
            }
        })?;
        let payload = aligner.observe(tick);
        let header = SampleHeader {
            seq: number,
            capture_ns: tick.0,
            recv_ns: now.0,
            encoding: Encoding::Bytes as u32,
            // Of no modality.
            id: u32::MAX,
            ..SampleHeader::default()
        };
        writer.publish(header, payload)
    }
}

fn modality(device: &DeviceSpec) -> SyncModality {
    device.synchronised(device.depth + SLACK)
}

/// The samples and masks so far, and the observation they give.
#[derive(Debug)]
struct Aligner {
    sync: Synchronizer<()>,
    judge: PictureJudge,
    /// Changes of the mask and when they were published, the oldest first.
    masks: VecDeque<(Stamp, Bits)>,
    payload: Vec<u8>,
}

impl Aligner {
    fn new(registry: &Registry, walked: Arc<WalkedPictures>) -> Self {
        let modalities: Vec<_> = registry.devices.iter().map(modality).collect();
        Self {
            sync: Synchronizer::new(&modalities, registry.rig.sync_window),
            judge: PictureJudge::sharing(walked),
            masks: VecDeque::with_capacity(MASKS),
            payload: Vec::with_capacity(HEAD_BYTES + modalities.len() * SLOT_BYTES),
        }
    }

    fn add(&mut self, device: &DeviceSpec) {
        self.sync.add(&modality(device));
    }

    fn receive(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8]) {
        match topic {
            TopicId::Modality(id) => self.sample(id, header, payload),
            TopicId::Mask => {
                if let Some((bits, _)) = Bits::of_payload(payload) {
                    self.mask(Stamp(header.capture_ns), bits);
                }
            }
            TopicId::Action | TopicId::Observation => {}
        }
    }

    /// A damaged sample belongs to no observation.
    fn sample(&mut self, id: ModalityId, header: &SampleHeader, payload: &[u8]) {
        let is_usable = self.judge.sample(id, header, payload).is_usable();
        if header.flags & FLAG_ERROR == 0 && is_usable {
            let (capture, recv, epoch) = (Stamp(header.capture_ns), Stamp(header.recv_ns), Epoch(header.epoch));
            self.sync.push(id, SyncSample { capture, recv, seq: header.seq, epoch, keep: () });
        }
    }

    fn mask(&mut self, published: Stamp, bits: Bits) {
        if self.masks.back().is_some_and(|(_, last)| *last == bits) {
            return;
        }
        if self.masks.len() == MASKS {
            self.masks.pop_front();
        }
        self.masks.push_back((published, bits));
    }

    /// The observation of this tick, as it is published: from what was received by then, under the mask last published
    /// by then.
    fn observe(&mut self, tick: Stamp) -> &[u8] {
        while self.masks.get(1).is_some_and(|(published, _)| *published <= tick) {
            self.masks.pop_front();
        }
        let in_force = self.masks.front().filter(|(published, _)| *published <= tick);
        let bits = in_force.map_or(Bits::default(), |(_, bits)| *bits);
        self.sync.observe(tick, tick, bits).encode(&mut self.payload);
        &self.payload
    }
}

#[cfg(test)]
mod tests {
    use rapid_core::mask::PhysicalMask;

    use super::*;

    const REGISTRY: &str = "[device.cam]\nvid = \"1209\"\npid = \"0001\"\nnode = \"camera\"\nbit = 0\n\
        [device.tof]\nvid = \"1209\"\npid = \"0002\"\nnode = \"serial\"\nbit = 3\ntty = { channels = 1 }\n";
    const MS: u64 = 1_000_000;

    /// Bit, flags, sequence number and age (ms) of each slot, after the mask.
    fn read(bytes: &[u8]) -> (u64, Vec<(u32, u32, u64, i64)>) {
        let (mask, slots) = bytes.split_first_chunk().expect("the mask");
        let slot = |bytes: &[u8]| {
            let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
            let long = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("8 bytes"));
            (word(0), word(4), long(8), long(16).cast_signed() / MS.cast_signed())
        };
        (u64::from_le_bytes(*mask), slots.chunks_exact(SLOT_BYTES).map(slot).collect())
    }

    #[test]
    fn an_observation_names_what_was_known_at_its_tick() {
        let registry = Registry::parse(REGISTRY, None).expect("a registry").registry;
        let mut aligner = Aligner::new(&registry, Arc::default());
        let [cam, tof] = [0, 1].map(|index| registry.devices[index].id);
        let sample = |seq: u64, captured: u64, received: u64, flags: u32| SampleHeader {
            seq,
            capture_ns: captured * MS,
            recv_ns: received * MS,
            epoch: 1,
            flags,
            ..SampleHeader::default()
        };
        let mask = |at: u64| SampleHeader { capture_ns: at * MS, ..SampleHeader::default() };
        let crashed = Bits { mask: PhysicalMask(0b1000), plugged: PhysicalMask(0b1001) };
        assert_eq!(read(aligner.observe(Stamp(50 * MS))), (0, vec![(0, 0, 0, 0), (3, 0, 0, 0)]), "before any mask");

        aligner.receive(TopicId::Mask, &mask(60), &Bits::from(PhysicalMask(0b1001)).payload(1));
        aligner.receive(TopicId::Mask, &mask(62), &Bits::from(PhysicalMask(0b1001)).payload(2));
        aligner.receive(TopicId::Mask, &mask(110), &crashed.payload(3));
        aligner.receive(TopicId::Mask, &mask(115), &Bits::from(PhysicalMask(0b1000)).payload(4));
        aligner.receive(TopicId::Mask, &mask(112), b"short");
        aligner.receive(TopicId::Modality(cam), &sample(7, 90, 95, 0), b"");
        // In transit at the tick; damaged.
        aligner.receive(TopicId::Modality(cam), &sample(8, 99, 101, 0), b"");
        aligner.receive(TopicId::Modality(cam), &sample(9, 100, 100, FLAG_ERROR), b"");
        aligner.receive(TopicId::Modality(tof), &sample(1, 40, 41, 0), b"");
        let (chosen, stale) = (1 | 2 | 8 | 16, 1 | 4 | 8 | 16);
        assert_eq!(read(aligner.observe(Stamp(100 * MS))), (0b1001, vec![(0, chosen, 7, 10), (3, stale, 1, 60)]));
        // Its driver failed, and it is unplugged: nothing of it, however fresh.
        assert_eq!(read(aligner.observe(Stamp(110 * MS))), (0b1000, vec![(0, 16, 0, 0), (3, stale, 1, 70)]));
        assert_eq!(read(aligner.observe(Stamp(115 * MS))), (0b1000, vec![(0, 0, 0, 0), (3, stale, 1, 75)]));
    }

    #[test]
    fn an_added_modality_is_in_the_next_observation() {
        let registry = Registry::parse(REGISTRY, None).expect("a registry").registry;
        let mut aligner = Aligner::new(&registry, Arc::default());
        aligner.receive(TopicId::Mask, &SampleHeader::default(), &Bits::from(PhysicalMask(0b110)).payload(1));
        assert_eq!(read(aligner.observe(Stamp(50 * MS))).1.len(), 2);
        let text = REGISTRY.replace("tof", "new").replace("bit = 3", "bit = 2");
        let added = Registry::parse(&text, None).expect("a registry").registry;
        aligner.add(&added.devices[1]);
        let header =
            SampleHeader { seq: 4, capture_ns: 90 * MS, recv_ns: 90 * MS, epoch: 1, ..SampleHeader::default() };
        aligner.receive(TopicId::Modality(added.devices[1].id), &header, b"");
        let seen = read(aligner.observe(Stamp(100 * MS)));
        assert_eq!(seen, (0b110, vec![(0, 0, 0, 0), (2, 1 | 2 | 8 | 16, 4, 10), (3, 0, 0, 0)]));
    }

    #[test]
    fn more_changes_of_the_mask_than_are_remembered_leave_the_newest() {
        let registry = Registry::parse(REGISTRY, None).expect("a registry").registry;
        let mut aligner = Aligner::new(&registry, Arc::default());
        for at in 0..1000 {
            aligner.mask(Stamp(at), PhysicalMask(at % 2).into());
        }
        assert_eq!(aligner.masks.capacity(), MASKS);
        assert_eq!(read(aligner.observe(Stamp(1000))).0, 1);
    }
}
