//! A program that reads a device for `rapid`: `node = "process_node"` in `devices.toml`.
//!
//!     [device.counter]
//!     vid = "0x2e8a"
//!     pid = "0x000a"
//!     node = "process_node"            # beside devices.toml, or on PATH
//!     [device.counter.process]
//!     args = ["--rate", "100"]
//!     kind = "scalars"
//!     channels = 2
//!
//! `rapid` starts it when the device is plugged and ends it with SIGTERM when it is pulled. It
//! publishes what it reads, here a counter, on the topic it is given, `/rapid/ingress/` and that of the
//! device; `rapid` takes it from there and publishes it on the topic of the device. Any language with
//! an iceoryx2 binding will do. What it prints goes to the log of `rapid`.
//!
//! Options: `--rate HZ`, `--channels N`; and to try what happens when a program misbehaves:
//! `--ignore-sigterm`, `--crash-after SAMPLES`, `--silent-after SAMPLES`, `--flood-stderr`, `--behind SECONDS` (its capture
//! times are that old; negative: in the future), `--same-number` (it does not count).

#![expect(clippy::print_stdout, clippy::print_stderr, reason = "what a program prints goes to the log of `rapid`")]

use std::error::Error;
use std::str::FromStr;
use std::time::{Duration, Instant};

use iceoryx2::prelude::*;
use rapid_bus::Header;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;

/// Reports SIGTERM and keeps running.
extern "C" fn on_sigterm(_: libc::c_int) {
    const WORDS: &[u8] = b"asked to end, keeps running\n";
    // SAFETY: pointer and length are those of one static slice.
    let _ = unsafe { libc::write(libc::STDOUT_FILENO, WORDS.as_ptr().cast(), WORDS.len()) };
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::from_arguments()?;
    if options.ignore_sigterm {
        // SAFETY: the handler calls nothing but write(2), which signal-safety(7) lists.
        unsafe { libc::signal(libc::SIGTERM, on_sigterm as extern "C" fn(libc::c_int) as libc::sighandler_t) };
    }
    if options.flood_stderr {
        std::thread::spawn(|| {
            for line in 0_u64.. {
                eprintln!("flood {line}");
                // A flood for any reader; without a pause it would stop a clock that waits for programs to wait.
                if line % 100 == 0 {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        });
    }
    let topic = std::env::var("RAPID_TOPIC")?;
    println!("reads {}, publishes on {topic}", std::env::var("DEVICE_NODE")?);

    let mut config = Config::global_config().clone();
    config.global.prefix = FileName::new(std::env::var("RAPID_BUS_PREFIX")?.as_bytes())?;
    if let Ok(root) = std::env::var("RAPID_BUS_ROOT") {
        config.global.set_root_path(&Path::new(root.as_bytes())?);
    }
    let node = NodeBuilder::new()
        .config(&config)
        // SIGTERM ends this program as it ends any other.
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()?;
    let name = ServiceName::new(&topic)?;
    let samples = node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<Header>().open()?;
    let publisher = samples.publisher_builder().initial_max_slice_len(8 * options.channels).create()?;
    // Without a notification a sample is found a little later.
    let wake = node.service_builder(&name).event().open()?.notifier_builder().create()?;

    let header = SampleHeader {
        id: number("RAPID_BIT")?,
        epoch: number("RAPID_EPOCH")?,
        encoding: Encoding::F64 as u32,
        ..SampleHeader::default()
    };
    let begun = Instant::now();
    for seq in 0_u32.. {
        if options.crash_after == Some(seq) {
            return Err(format!("crashes after {seq} samples, as requested").into());
        }
        if options.silent_after == Some(seq) {
            std::thread::sleep(Duration::MAX);
        }
        let mut values = vec![0.0; options.channels];
        values[0] = f64::from(seq);
        let payload: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        let mut sample = publisher.loan_slice_uninit(payload.len())?;
        let number = if options.same_number { 7 } else { seq.into() };
        *sample.user_header_mut() = Header(SampleHeader { seq: number, capture_ns: options.captured().0, ..header });
        sample.write_from_slice(&payload).send()?;
        wake.notify()?;
        let due = begun + Duration::from_secs_f64(f64::from(seq + 1) / options.rate);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
    Ok(())
}

fn number(variable: &str) -> Result<u32, Box<dyn Error>> {
    Ok(std::env::var(variable)?.parse()?)
}

struct Options {
    rate: f64,
    channels: usize,
    ignore_sigterm: bool,
    crash_after: Option<u32>,
    silent_after: Option<u32>,
    flood_stderr: bool,
    behind: f64,
    same_number: bool,
}

impl Options {
    fn from_arguments() -> Result<Self, Box<dyn Error>> {
        let mut options = Self {
            rate: 100.0,
            channels: 2,
            ignore_sigterm: false,
            crash_after: None,
            silent_after: None,
            flood_stderr: false,
            behind: 0.0,
            same_number: false,
        };
        let mut arguments = std::env::args().skip(1);
        while let Some(option) = arguments.next() {
            match option.as_str() {
                "--rate" => options.rate = value(&option, arguments.next())?,
                "--channels" => options.channels = value(&option, arguments.next())?,
                "--behind" => options.behind = value(&option, arguments.next())?,
                "--ignore-sigterm" => options.ignore_sigterm = true,
                "--crash-after" => options.crash_after = Some(value(&option, arguments.next())?),
                "--silent-after" => options.silent_after = Some(value(&option, arguments.next())?),
                "--same-number" => options.same_number = true,
                "--flood-stderr" => options.flood_stderr = true,
                other => return Err(format!("unknown option {other}").into()),
            }
        }
        Ok(options)
    }

    fn captured(&self) -> Stamp {
        let distance = Duration::from_secs_f64(self.behind.abs());
        if self.behind < 0.0 { Stamp::now().after(distance) } else { Stamp::now().before(distance) }
    }
}

fn value<T: FromStr>(option: &str, text: Option<String>) -> Result<T, Box<dyn Error>> {
    text.and_then(|text| text.parse().ok()).ok_or_else(|| format!("{option} needs a number").into())
}
