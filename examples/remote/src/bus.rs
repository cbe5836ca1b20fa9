//! Samples and mask of the `rapid` on this computer, as any subscriber reads them.
//!
//! Each reader has a thread of its own, because ports of the bus do not change threads. A bus whose `rapid` has ended is
//! let go, so that the next one starts on a clean bus, and is opened again when there is a mask.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use iceoryx2::node::Node;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use rapid_bus::Header;
use rapid_core::mask::{Bits, MASK_TOPIC, PhysicalMask};
use rapid_core::sample::SampleHeader;

use crate::Fault;

/// Between two looks at the bus.
const LOOK: Duration = Duration::from_millis(1);
/// Between two tries to open it.
const RETRY: Duration = Duration::from_millis(200);
/// 200 publications of the mask: without one for this long `rapid` has ended.
const SILENCE: Duration = Duration::from_millis(400);

/// Which `rapid` of this computer.
#[derive(Debug, Clone)]
pub struct Place {
    /// What it was given as `--instance`.
    pub instance: Option<String>,
}

/// How often `rapid` was found running: odd while it is.
#[derive(Debug, Clone, Default)]
pub struct Running(Arc<AtomicU64>);

impl Running {
    fn now(&self) -> Option<u64> {
        let count = self.0.load(Ordering::Acquire);
        (count % 2 == 1).then_some(count)
    }

    fn set(&self, is_running: bool) {
        if self.now().is_some() != is_running {
            self.0.fetch_add(1, Ordering::AcqRel);
        }
    }
}

type Samples = Subscriber<ipc::Service, [u8], Header>;

/// A topic that is open.
struct Topic {
    node: Node<ipc::Service>,
    samples: Samples,
}

impl Topic {
    fn open(place: &Place, topic: &str, depth: usize) -> Result<Self, Fault> {
        let fault = |error: &dyn std::fmt::Debug| format!("{topic}: {error:?}");
        let mut config = Config::global_config().clone();
        if let Some(instance) = &place.instance {
            let prefix = FileName::new(format!("iox2_{instance}_").as_bytes()).map_err(|error| fault(&error))?;
            config.global.prefix = prefix;
        }
        if let Ok(root) = std::env::var("RAPID_BUS_ROOT") {
            let root = iceoryx2::prelude::Path::new(root.as_bytes()).map_err(|error| fault(&error))?;
            config.global.set_root_path(&root);
        }
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<ipc::Service>()
            .map_err(|error| fault(&error))?;
        let name = ServiceName::new(topic).map_err(|error| fault(&error))?;
        let service = node
            .service_builder(&name)
            .publish_subscribe::<[u8]>()
            .user_header::<Header>()
            .open()
            .map_err(|error| fault(&error))?;
        let samples = service.subscriber_builder().buffer_size(depth).create().map_err(|error| fault(&error))?;
        Ok(Self { node, samples })
    }
}

/// Follows the mask: `take` gets it every `LOOK` whether it has changed or not, `None` while no `rapid` runs. Never
/// returns.
pub fn follow_mask(place: &Place, running: &Running, mut take: impl FnMut(Option<PhysicalMask>)) {
    loop {
        take(None);
        let Ok(topic) = Topic::open(place, MASK_TOPIC, 16) else {
            std::thread::sleep(RETRY);
            continue;
        };
        let (mut newest, mut mask) = (Instant::now(), None);
        while newest.elapsed() < SILENCE {
            while let Ok(Some(sample)) = topic.samples.receive() {
                if let Some((bits, _)) = Bits::of_payload(sample.payload()) {
                    (newest, mask) = (Instant::now(), Some(bits.mask));
                    running.set(true);
                }
            }
            take(mask);
            if topic.node.wait(LOOK).is_err() {
                break;
            }
        }
        running.set(false);
    }
}

/// Reads a topic whenever `rapid` runs; `depth` samples may wait, the oldest are dropped. Never returns.
pub fn read(place: &Place, running: &Running, topic: &str, depth: usize, mut take: impl FnMut(&SampleHeader, &[u8])) {
    let mut reported = None;
    loop {
        let Some(run) = running.now() else {
            std::thread::sleep(RETRY);
            continue;
        };
        let open = match Topic::open(place, topic, depth) {
            Ok(open) => open,
            Err(fault) => {
                if reported.replace(run) != Some(run) {
                    tracing::warn!("{fault}: is --config the registry of the rapid that runs here?");
                }
                std::thread::sleep(RETRY);
                continue;
            }
        };
        while running.now() == Some(run) {
            while let Ok(Some(sample)) = open.samples.receive() {
                take(sample.user_header(), sample.payload());
            }
            if open.node.wait(LOOK).is_err() {
                // It is opened again, if that run is still there.
                std::thread::sleep(RETRY);
                break;
            }
        }
    }
}
