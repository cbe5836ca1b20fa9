//! Subscribes to a topic of a running `rapid` and prints a line for each sample.
//!
//!     subscribe /rapid/camera/wrist 5
//!
//! It ends after so many samples, by default never. `RAPID_INSTANCE` is what that `rapid` was given as `--instance`.

#![expect(clippy::print_stdout, reason = "a program's output is for its caller")]

use std::error::Error;
use std::time::Duration;

use iceoryx2::prelude::*;
use rapid_bus::Header;
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;

/// Between two looks.
const LOOK: Duration = Duration::from_millis(1);

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let topic = arguments.next().ok_or("usage: subscribe TOPIC [COUNT]")?;
    let mut left: u64 = arguments.next().map_or(Ok(u64::MAX), |count| count.parse())?;

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
    let name = ServiceName::new(&topic)?;
    let samples = node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<Header>().open()?;
    let subscriber = samples.subscriber_builder().create()?;

    let mut newest: Option<SampleHeader> = None;
    while left > 0 {
        let Some(sample) = subscriber.receive()? else {
            node.wait(LOOK)?;
            continue;
        };
        let header = sample.user_header().0;
        if let Some(before) = newest {
            let missing = header.seq.wrapping_sub(before.seq + 1);
            if missing > 0 {
                // What the device itself did not lose was overwritten before this program read it.
                println!("{missing} samples missing, {} of them lost by the device", header.lost - before.lost);
            }
        }
        let age = Stamp::now().since(Stamp(header.capture_ns));
        println!("seq {} epoch {} age {age:.1?}, {} bytes", header.seq, header.epoch, sample.payload().len());
        newest = Some(header);
        left -= 1;
    }
    Ok(())
}
