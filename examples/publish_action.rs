//! A program that commands an actuator: it publishes actions on `/action`, as a policy would.
//!
//!     rapid --headless --config devices.toml --arm &
//!     publish_action --axes 2 --rate 10 --amplitude 0.3
//!
//! An action is a list of numbers, one an axis, in the order and the units of the actuator's entry; its
//! capture time is the moment it is for. Here they follow a sine around 0. Real motors move only after
//! they were armed; when actions stop coming they hold, and after a while they are disabled.
//!
//! Options: `--axes N`, `--rate HZ`, `--amplitude A`, `--period SECONDS`, `--seconds S` (0: for ever).

#![expect(clippy::print_stdout, reason = "a program's output is for its caller")]

use std::error::Error;
use std::f64::consts::TAU;
use std::time::{Duration, Instant};

use iceoryx2::prelude::*;
use rapid_bus::Header;
use rapid_core::action::ACTION_TOPIC;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::from_arguments()?;
    let mut config = Config::global_config().clone();
    // Another bus is set only for a program that `rapid` started, or for a second rig.
    if let Ok(prefix) = std::env::var("RAPID_BUS_PREFIX") {
        config.global.prefix = FileName::new(prefix.as_bytes())?;
    }
    if let Ok(root) = std::env::var("RAPID_BUS_ROOT") {
        config.global.set_root_path(&Path::new(root.as_bytes())?);
    }
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()?;
    let name = ServiceName::new(ACTION_TOPIC)?;
    let actions = node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<Header>().open()?;
    let publisher = actions.publisher_builder().initial_max_slice_len(8 * options.axes).create()?;
    // Without a notification an action is found with the actuator's next cycle.
    let wake = node.service_builder(&name).event().open()?.notifier_builder().create()?;
    println!("publishes {} numbers at {} Hz on {ACTION_TOPIC}", options.axes, options.rate);

    let begun = Instant::now();
    for seq in 0_u32.. {
        let seconds = f64::from(seq) / options.rate;
        if options.seconds > 0.0 && seconds >= options.seconds {
            break;
        }
        let value = options.amplitude * (TAU * seconds / options.period).sin();
        let payload = value.to_le_bytes().repeat(options.axes);
        let mut sample = publisher.loan_slice_uninit(payload.len())?;
        *sample.user_header_mut() = Header(SampleHeader {
            seq: seq.into(),
            capture_ns: Stamp::now().0,
            encoding: Encoding::F64 as u32,
            ..SampleHeader::default()
        });
        sample.write_from_slice(&payload).send()?;
        wake.notify()?;
        let due = begun + Duration::from_secs_f64(f64::from(seq + 1) / options.rate);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
    Ok(())
}

struct Options {
    axes: usize,
    rate: f64,
    amplitude: f64,
    period: f64,
    seconds: f64,
}

impl Options {
    fn from_arguments() -> Result<Self, Box<dyn Error>> {
        let mut options = Self { axes: 1, rate: 10.0, amplitude: 0.3, period: 4.0, seconds: 0.0 };
        let mut arguments = std::env::args().skip(1);
        while let Some(option) = arguments.next() {
            let number = |text: Option<String>| -> Result<f64, Box<dyn Error>> {
                let number = text.and_then(|text| text.parse().ok()).filter(|number: &f64| number.is_finite());
                number.ok_or_else(|| format!("{option} needs a number").into())
            };
            let mut above_zero = || {
                let number = number(arguments.next())?;
                if number > 0.0 { Ok(number) } else { Err(Box::<dyn Error>::from(format!("{option} is above 0"))) }
            };
            match option.as_str() {
                "--axes" => options.axes = above_zero()?.to_string().parse()?,
                "--rate" => options.rate = above_zero()?,
                "--period" => options.period = above_zero()?,
                "--amplitude" => options.amplitude = number(arguments.next())?,
                "--seconds" => options.seconds = number(arguments.next())?,
                other => return Err(format!("unknown option {other}").into()),
            }
        }
        Ok(options)
    }
}
