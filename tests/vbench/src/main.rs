//! `usbemu`: emulated USB devices, and the bench's probes inside the guest.

use std::io;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use vbench::emu::device::Device;
use vbench::emu::frame::first_number;
use vbench::emu::function::{Function, PictureStore};
use vbench::emu::log::{Log, Moment};
use vbench::emu::script;
use vbench::emu::spec::{DeviceSpec, PORTS};
use vbench::probe::{beat, can, keys, lan, mask, uevent, v4l};

const USAGE: &str = "\
usage: usbemu SPEC...                    emulate; commands on stdin (plug, unplug, hub, silent, port, sleep, t0,
                                         at, say, fault, mute, hot, power, ask, flood, busoff, link, level, quit)
       usbemu --read NODE FRAMES         read a camera, print what came as one JSON object
       usbemu --first-frames             open each camera that comes, print how soon its first frame came
       usbemu --can NAME FRAME...        send each (ID#DATA), print the next frame that comes or -
       usbemu --can-stream NAME FRAME US send one every US microseconds until the interface is gone
       usbemu --can-count NAME FRAMES    read generated frames, print how many were lost
       usbemu --lidar PORT PACKETS       read a LiDAR's packets, print how many were lost
       usbemu --watch-mask [SECONDS]     print each change of the physical mask as a JSON line
       usbemu --watch-uevents            print the device events of the kernel and udev, a JSON line each
       usbemu --keys NAME KEY...         an input device with these keys: `press KEY`, `release KEY` on stdin
       usbemu --grab NODE                keep an input device's events from everybody else
       usbemu --beat MICROSECONDS FILE   sleep to absolute deadlines, note each waking in FILE

SPEC: uvc:vid=046d,pid=0825,serial=A,port=0,mode=MJPG-640x480@30[,mode=..]
      uvc:mode=Z16-64x48@15,also=YUYV-64x48@15[,mode=..]   one device of two cameras; at most four
      acm:vid=2e8a,pid=000a,serial=B,hz=100
      ftdi:vid=0403,pid=6001,serial=C,hz=50
      gsusb:serial=D,motor=5/15/DMH3510[,motor=..]   slcan:..   damiao:..
      ecm:serial=C3441325012345[,gopro=MEGABYTES][,lidar=HZ]   gpio:serial=E
      feed=FILE with the first three: send the records of this file";

type Failure = Box<dyn std::error::Error>;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let done = match words[..] {
        [] | ["-h" | "--help"] => {
            println!("{USAGE}");
            return if words.is_empty() { ExitCode::FAILURE } else { ExitCode::SUCCESS };
        }
        ["--read", node, frames] => read(node, frames),
        ["--first-frames"] => v4l::first_frames(&Log::new(Box::new(io::stdout()))).map_err(Failure::from),
        ["--watch-uevents"] => uevent::watch(&Log::new(Box::new(io::stdout()))).map_err(Failure::from),
        ["--beat", micros, file] => beat(micros, file),
        ["--can", name, ref frames @ ..] if !frames.is_empty() => can::ask(name, frames).map_err(Failure::from),
        ["--can-stream", name, frame, micros] => stream(name, frame, micros),
        ["--can-count", name, frames] => count(name, frames),
        ["--lidar", port, packets] => lidar(port, packets),
        ["--watch-mask"] => watch(None),
        ["--watch-mask", seconds] => watch(Some(seconds)),
        ["--keys", name, ref codes @ ..] if !codes.is_empty() => keys::serve(name, codes, io::stdin().lock()),
        ["--grab", node] => keys::grab(Path::new(node)),
        _ => emulate(&words),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("usbemu: {error}");
            ExitCode::FAILURE
        }
    }
}

fn emulate(specs: &[&str]) -> Result<(), Failure> {
    let log = Arc::new(Log::new(Box::new(io::stdout())));
    let mut store = PictureStore::new();
    let mut devices = Vec::with_capacity(specs.len());
    for (index, text) in specs.iter().enumerate() {
        let spec: DeviceSpec = text.parse()?;
        let function = Function::new(&spec, first_number(index), &mut store)?;
        let port =
            spec.port.or(u8::try_from(index).ok()).filter(|port| *port < PORTS).ok_or("more devices than ports")?;
        devices.push(Device::new(index, port, function, Arc::clone(&log)));
    }
    log.write("ready", Moment::now(), serde_json::json!({"devices": devices.len()}));
    script::run(io::stdin().lock(), &mut devices, &log);
    Ok(())
}

fn read(node: &str, frames: &str) -> Result<(), Failure> {
    println!("{}", v4l::read(Path::new(node), frames.parse()?)?);
    Ok(())
}

fn stream(name: &str, frame: &str, micros: &str) -> Result<(), Failure> {
    println!("{}", can::stream(name, frame, Duration::from_micros(micros.parse()?))?);
    Ok(())
}

fn count(name: &str, frames: &str) -> Result<(), Failure> {
    println!("{}", can::count(name, frames.parse()?)?);
    Ok(())
}

fn lidar(port: &str, packets: &str) -> Result<(), Failure> {
    println!("{}", lan::count(port.parse()?, packets.parse()?)?);
    Ok(())
}

fn beat(micros: &str, file: &str) -> Result<(), Failure> {
    Ok(beat::run(Duration::from_micros(micros.parse()?), Path::new(file))?)
}

fn watch(seconds: Option<&str>) -> Result<(), Failure> {
    let limit = seconds.map(str::parse).transpose()?.map(Duration::from_secs);
    let log = Log::new(Box::new(io::stdout()));
    mask::watch(Path::new(mask::MASK_PATH), limit, &log);
    Ok(())
}
