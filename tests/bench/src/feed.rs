//! The messages of the full load, created once: the recorder and the `mcap` crate read them from memory.

use std::sync::Arc;

use rapid_bus::TopicId;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_devices::driver::sim;
use rapid_episode::encode;
use rapid_episode::schema::{self, SampleSchema};
use rapid_registry::Registry;
use rapid_registry::scenario::Scenario;
use rapid_registry::simulation::SimSource;

use crate::Failure;

const REGISTRY: &str = include_str!("../scenarios/load.devices.toml");
const LOAD: &str = include_str!("../scenarios/load.toml");
/// Different payloads of a device.
const PAYLOADS: u32 = 8;
/// Rate of the mask.
const MASK_HZ: u64 = 500;

/// The registry and the scenario of the full load.
pub(crate) fn rig() -> Result<(Registry, Scenario), Failure> {
    let registry = Registry::parse(REGISTRY, None)?.registry;
    let scenario = Scenario::parse(LOAD, None, &registry)?;
    Ok((registry, scenario))
}

/// One device of the load, or the mask.
#[derive(Debug, Clone)]
pub(crate) struct Lane {
    /// Its topic.
    pub topic: TopicId,
    /// Topic's name in a file.
    pub name: String,
    /// Its schema.
    pub schema: SampleSchema,
    /// All fields except times and numbers.
    pub header: SampleHeader,
    /// Its payloads, sent in turn.
    pub payloads: Vec<Vec<u8>>,
    /// The same as messages of a file.
    pub messages: Vec<Vec<u8>>,
    /// Messages per second.
    pub hz: u64,
}

/// All lanes and the message order of one second.
#[derive(Debug, Clone)]
pub(crate) struct Feed {
    /// See [`Lane`].
    pub lanes: Arc<Vec<Lane>>,
    /// The lane of every message of a second.
    pub second: Arc<Vec<usize>>,
}

impl Feed {
    /// The full load.
    pub(crate) fn full_load() -> Result<Self, Failure> {
        let (registry, scenario) = rig()?;
        let mut lanes = Vec::new();
        for device in &scenario.devices {
            let spec = registry.named(&device.name).ok_or("a device without entry")?;
            let (encoding, hz, width, height) = match device.source {
                SimSource::Camera { width, height, fps, .. } => (Encoding::Mjpeg, fps, width, height),
                SimSource::Serial { channels, hz, .. } => (Encoding::F64, hz, u32::try_from(channels)?, 0),
                SimSource::Depth { .. } | SimSource::Task { .. } | SimSource::Replay { .. } | SimSource::Process => {
                    return Err("the load is made of cameras and serial lines".into());
                }
            };
            let payloads: Vec<Vec<u8>> =
                (0..PAYLOADS).filter_map(|number| sim::frame(&device.source, number)).collect();
            let id = u32::from(spec.id.bit());
            let header =
                SampleHeader { id, epoch: 1, encoding: encoding as u32, width, height, ..SampleHeader::default() };
            lanes.push(lane(spec.id, &spec.topic, &spec.name, header, payloads, u64::from(hz)));
        }
        let mask = SampleHeader { encoding: Encoding::Mask as u32, ..SampleHeader::default() };
        let mut message = Vec::new();
        encode::mask(&mut message, u64::MAX / 2, rapid_core::mask::PhysicalMask(0x1f), 1 << 20);
        lanes.push(Lane {
            topic: TopicId::Mask,
            name: "/rapid/mask".to_owned(),
            schema: SampleSchema::Bytes,
            header: mask,
            payloads: vec![[0x1f_u64, 1, 0x1f].map(u64::to_le_bytes).concat()],
            messages: vec![message],
            hz: MASK_HZ,
        });
        Ok(Self { second: Arc::new(order(&lanes)), lanes: Arc::new(lanes) })
    }

    /// Message bytes per second.
    pub(crate) fn bytes(&self) -> u64 {
        let of = |lane: &Lane| lane.messages.iter().map(Vec::len).sum::<usize>() / lane.messages.len().max(1);
        self.lanes.iter().map(|lane| of(lane) as u64 * lane.hz).sum()
    }
}

fn lane(id: ModalityId, topic: &str, frame_id: &str, header: SampleHeader, payloads: Vec<Vec<u8>>, hz: u64) -> Lane {
    let schema = payloads.first().map_or(SampleSchema::Bytes, |payload| SampleSchema::for_sample(&header, payload));
    let encoded = |payload: &Vec<u8>| {
        let mut message = Vec::new();
        encode::sample(&mut message, schema, u64::MAX / 2, frame_id, &header, payload);
        message
    };
    let messages = payloads.iter().map(encoded).collect();
    let name = topic.to_owned();
    Lane { topic: TopicId::Modality(id), name, schema, header, payloads, messages, hz }
}

/// The messages of a second, ordered by due time.
fn order(lanes: &[Lane]) -> Vec<usize> {
    let mut due: Vec<(u64, usize)> = lanes
        .iter()
        .enumerate()
        .flat_map(|(place, lane)| (0..lane.hz).map(move |number| (number * 1_000_000 / lane.hz.max(1), place)))
        .collect();
    due.sort_unstable();
    due.into_iter().map(|(_, place)| place).collect()
}

/// Schema of a lane in a file.
pub(crate) fn schema_of(lane: &Lane) -> schema::Schema {
    if lane.topic == TopicId::Mask { schema::MASK } else { lane.schema.schema() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_second_of_load_matches_the_request() {
        let feed = Feed::full_load().unwrap();
        assert_eq!(feed.second.len(), 4 * 60 + 1000 + 500);
        let of = |lane: usize| feed.second.iter().filter(|place| **place == lane).count() as u64;
        for (place, lane) in feed.lanes.iter().enumerate() {
            assert_eq!(of(place), lane.hz, "{}", lane.name);
        }
        let pictures = feed.lanes.iter().filter(|lane| lane.schema == SampleSchema::CompressedImage);
        assert_eq!(pictures.clone().count(), 4);
        assert!(pictures.flat_map(|lane| &lane.payloads).all(|picture| (60_000..60_100).contains(&picture.len())));
        assert!((14_400_000..15_000_000).contains(&feed.bytes()), "{}", feed.bytes());
    }
}
