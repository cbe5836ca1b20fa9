//! Puts the observations of a running `rapid` together: of each tick the sample of every topic that belongs to it.
//!
//!     observe 5 /rapid/camera/wrist /rapid/serial/motor
//!
//! It ends after so many observations. `RAPID_INSTANCE` is what that `rapid` was given as `--instance`.

#![expect(clippy::print_stdout, reason = "a program's output is for its caller")]

use std::collections::{BTreeMap, VecDeque};
use std::error::Error;
use std::time::Duration;

use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use rapid::modality::ModalityId;
use rapid::observation::{OBSERVATION_TOPIC, Observation};
use rapid::sample::SampleHeader;
use rapid::time::Stamp;

/// Between two looks.
const LOOK: Duration = Duration::from_millis(2);
/// Samples of a topic that are kept until an observation names one of them.
const KEPT: usize = 64;

type Inbox = Subscriber<ipc::Service, [u8], SampleHeader>;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let mut left: u64 = arguments.next().ok_or("usage: observe COUNT TOPIC...")?.parse()?;
    let topics: Vec<String> = arguments.collect();

    let mut config = Config::global_config().clone();
    if let Ok(instance) = std::env::var("RAPID_INSTANCE") {
        config.global.prefix = FileName::new(format!("iox2_{instance}_").as_bytes())?;
    }
    if let Ok(root) = std::env::var("RAPID_BUS_ROOT") {
        config.global.set_root_path(&Path::new(root.as_bytes())?);
    }
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()?;
    let inbox = |topic: &str| -> Result<Inbox, Box<dyn Error>> {
        let service = node.service_builder(&ServiceName::new(topic)?).publish_subscribe::<[u8]>();
        Ok(service.user_header::<SampleHeader>().open()?.subscriber_builder().create()?)
    };
    // The observations last: fewer of them name samples from before the subscription.
    let inboxes = topics.iter().map(|topic| inbox(topic)).collect::<Result<Vec<_>, _>>()?;
    let ticks = inbox(OBSERVATION_TOPIC)?;

    let mut samples: BTreeMap<u32, VecDeque<(u64, Vec<u8>)>> = BTreeMap::new();
    while left > 0 {
        let Some(tick) = ticks.receive()? else {
            node.wait(LOOK)?;
            continue;
        };
        // Read after the observation: the samples that it names are there.
        for inbox in &inboxes {
            while let Some(sample) = inbox.receive()? {
                let header = sample.user_header();
                let kept = samples.entry(header.id).or_default();
                kept.push_back((header.seq, sample.payload().to_vec()));
                if kept.len() > KEPT {
                    kept.pop_front();
                }
            }
        }
        let observation = Observation::decode(Stamp(tick.user_header().capture_ns), tick.payload());
        println!("{}", line(&observation.ok_or("no observation")?, &samples));
        left -= 1;
    }
    Ok(())
}

/// The mask, and of each modality what a consumer has: the bytes of its sample, or nothing, which is to be zeros.
fn line(observation: &Observation, samples: &BTreeMap<u32, VecDeque<(u64, Vec<u8>)>>) -> String {
    let bytes = |id: ModalityId, seq: u64| {
        let kept = samples.get(&u32::from(id.bit()))?;
        kept.iter().find(|(number, _)| *number == seq).map(|(_, payload)| payload.len())
    };
    let slots = observation.slots.iter().map(|slot| {
        let state = if slot.valid {
            "valid"
        } else if slot.present {
            "stale"
        } else if slot.plugged {
            "plugged in, not running"
        } else {
            "absent"
        };
        let held = slot.seq.and_then(|seq| bytes(slot.id, seq));
        let held = held.map_or_else(|| "zeros".to_owned(), |bytes| format!("{bytes} bytes"));
        format!("; {}: {state}, {held}", slot.id.bit())
    });
    format!("mask {:#04x}{}", observation.mask.0, slots.collect::<String>())
}
