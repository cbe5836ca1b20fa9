//! Prints the observations of a running `rapid`: of each tick an array of fixed shape for every topic, whatever is plugged in.
//!
//!     observe 5 /rapid/camera/wrist=480x640x3 /rapid/serial/motor=3
//!
//! Pictures are `HEIGHTxWIDTHx3`, depth `HEIGHTxWIDTH`, numbers their count. Of a topic that is absent, or whose sample
//! cannot be used, the array is zeros. It ends after so many observations. `RAPID_INSTANCE` is what that `rapid` was given as
//! `--instance`.

#![expect(clippy::print_stdout, reason = "a program's output is for its caller")]

use std::collections::VecDeque;
use std::error::Error;
use std::fmt::Write as _;
use std::time::Duration;

use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use rapid_bus::Header;
use rapid_core::observation::{OBSERVATION_TOPIC, Observation, ObservationSlot};
use rapid_core::sample::{Encoding, FLAG_ERROR, SampleHeader};
use rapid_core::time::Stamp;
use rapid_pictures::pixels::{CHANNELS, Picture, Pixels};

/// Between two looks.
const LOOK: Duration = Duration::from_millis(2);
/// Samples of a topic that are kept until an observation names one of them.
const KEPT: usize = 64;

type Inbox = Subscriber<ipc::Service, [u8], Header>;

/// A topic of which each observation has an array.
struct Topic {
    name: String,
    shape: Vec<usize>,
    inbox: Inbox,
    kept: VecDeque<(SampleHeader, Vec<u8>)>,
    /// Its bit, which is known from its first sample on.
    bit: Option<u32>,
}

/// What an observation has of a topic.
struct Array {
    state: &'static str,
    /// From the moment that the sample shows to the tick, ms; none without a usable sample.
    age: Option<f64>,
    /// As many as its shape has; zeros without a usable sample.
    values: Vec<f64>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let mut left: u64 = arguments.next().ok_or("usage: observe COUNT TOPIC=SHAPE...")?.parse()?;

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
        Ok(service.user_header::<Header>().open()?.subscriber_builder().create()?)
    };
    // The observations last: fewer of them name samples from before the subscription.
    let topic = |argument: String| -> Result<Topic, Box<dyn Error>> {
        let (name, shape) = argument.split_once('=').ok_or_else(|| format!("{argument}: write TOPIC=SHAPE"))?;
        let shape = shape.split('x').map(str::parse).collect::<Result<_, _>>()?;
        Ok(Topic { name: name.to_owned(), shape, inbox: inbox(name)?, kept: VecDeque::new(), bit: None })
    };
    let mut topics = arguments.map(topic).collect::<Result<Vec<_>, _>>()?;
    let ticks = inbox(OBSERVATION_TOPIC)?;

    let mut pixels = Pixels::default();
    while left > 0 {
        let Some(tick) = ticks.receive()? else {
            node.wait(LOOK)?;
            continue;
        };
        let header = tick.user_header().0;
        let observation = Observation::decode(Stamp(header.capture_ns), tick.payload()).ok_or("no observation")?;
        let mut line = format!("tick {} mask {:#04x}", header.seq, observation.mask.0);
        for topic in &mut topics {
            // Read after the observation: the samples that it names are there.
            topic.receive()?;
            let Array { state, age, values } = topic.array(&observation, &mut pixels)?;
            let age = age.map_or_else(|| "no sample".to_owned(), |age| format!("{age:.1} ms"));
            let (shape, summary) = (shown(&topic.shape), summary(&topic.shape, &values));
            write!(line, "; {}: {state}, {age}, {shape}, {summary}", topic.name)?;
        }
        println!("{line}");
        left -= 1;
    }
    Ok(())
}

impl Topic {
    fn receive(&mut self) -> Result<(), Box<dyn Error>> {
        while let Some(sample) = self.inbox.receive()? {
            let header = sample.user_header().0;
            self.bit = Some(header.id);
            self.kept.push_back((header, sample.payload().to_vec()));
            if self.kept.len() > KEPT {
                self.kept.pop_front();
            }
        }
        Ok(())
    }

    fn array(&self, observation: &Observation, pixels: &mut Pixels) -> Result<Array, Box<dyn Error>> {
        let slot = observation.slots.iter().find(|slot| Some(u32::from(slot.id.bit())) == self.bit);
        let chosen = slot.and_then(|slot| slot.seq);
        let sample = self.kept.iter().find(|(header, _)| Some(header.seq) == chosen);
        let values = sample.map(|(header, payload)| self.values(header, payload, pixels)).transpose()?.flatten();
        let state = match slot {
            Some(ObservationSlot { valid: true, .. }) if values.is_some() => "valid",
            Some(ObservationSlot { present: true, .. }) => "stale",
            Some(ObservationSlot { plugged: true, .. }) => "plugged in, not running",
            _ => "absent",
        };
        let age = slot.filter(|_| values.is_some()).map(|slot| slot.age_ns as f64 / 1e6);
        Ok(Array { state, age, values: values.unwrap_or_else(|| vec![0.0; self.shape.iter().product()]) })
    }

    /// The numbers of a sample; `None` if it is damaged. A whole sample of another shape is an error of the caller.
    fn values(
        &self,
        header: &SampleHeader,
        payload: &[u8],
        pixels: &mut Pixels,
    ) -> Result<Option<Vec<f64>>, Box<dyn Error>> {
        if header.flags & FLAG_ERROR != 0 {
            return Ok(None);
        }
        let (width, height) = (header.width, header.height);
        let (shape, values): (Vec<usize>, Vec<f64>) = match Encoding::from_raw(header.encoding) {
            Some(Encoding::F64) => {
                let numbers: Vec<_> = payload.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
                (vec![numbers.len()], numbers)
            }
            Some(Encoding::Depth) => {
                let counts = payload.as_chunks().0.iter().map(|bytes| u16::from_le_bytes(*bytes).into());
                (vec![usize::try_from(height)?, usize::try_from(width)?], counts.collect())
            }
            Some(encoding) if encoding.is_picture() => {
                match pixels.decode(&Picture { encoding, width, height, bytes: payload }) {
                    Ok([height, width]) => {
                        (vec![height, width, CHANNELS], pixels.values().iter().copied().map(f64::from).collect())
                    }
                    Err(_) => return Ok(None),
                }
            }
            _ => return Err(format!("{}: its samples are not an array: see examples/subscribe.rs", self.name).into()),
        };
        if shape != self.shape {
            let (found, wanted) = (shown(&shape), shown(&self.shape));
            return Err(format!("{}: its samples are {found}, not {wanted}", self.name).into());
        }
        Ok(Some(values))
    }
}

fn shown(shape: &[usize]) -> String {
    shape.iter().map(usize::to_string).collect::<Vec<_>>().join("x")
}

/// The first numbers of a vector, the mean of a picture.
fn summary(shape: &[usize], values: &[f64]) -> String {
    if shape.len() == 1 {
        let first: Vec<_> = values.iter().take(6).map(|value| format!("{value:.3}")).collect();
        return format!("[{}]", first.join(", "));
    }
    format!("mean {:.3}", values.iter().sum::<f64>() / values.len().max(1) as f64)
}
