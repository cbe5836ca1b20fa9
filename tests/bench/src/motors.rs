//! How well thread `control` keeps its cycle, how soon an action is on the wire, and the cost of a motor's answer.
//!
//! Actions are published on the bus, as a policy of this process does. The motors are those of the virtual bench, behind
//! Damiao's adapter on a pseudo-terminal.

#[path = "../../support/motors.rs"]
pub(crate) mod adapter;

use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rapid_bus::{Bus, TopicId, Writer};
use rapid_core::action::Order;
use rapid_core::random::Random;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;
use rapid_devices::driver::can::link::Link;
use rapid_devices::driver::can::motors::{Motors, Punctuality};
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::motors::MotorBus;

use self::adapter::{Adapter, spec};
use crate::beat::sleep_until;
use crate::disarm;
use crate::figure::Figure;
use crate::stats::{Sorted, median};
use crate::{Bench, Failure, LIMIT};

const AXES: u16 = 6;
const CYCLE: Duration = Duration::from_millis(5);

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let length = bench.length(20, 4);
    let (mut runs, mut quick, mut bare) = (Vec::new(), Vec::new(), Vec::new());
    for run in 0..bench.runs {
        bench.progress(&format!("motors: run {} of {}, {} s each", run + 1, bench.runs, 2 * length.as_secs()));
        bare.push(beat(length));
        runs.push(drive(length, Duration::from_millis(100))?);
        quick.push(drive(length, CYCLE)?);
    }
    let of = |value: &dyn Fn(&Punctuality) -> f64| median(&runs.iter().map(value).collect::<Vec<_>>());
    let of_quick = |value: &dyn Fn(&Punctuality) -> f64| median(&quick.iter().map(value).collect::<Vec<_>>());
    let bare = |share| median(&bare.iter().filter_map(|run: &Sorted| run.quantile(share)).collect::<Vec<_>>());
    let cycles: u64 = runs.iter().map(|run| run.cycles).sum();
    let note = format!(
        "{cycles} cycles at 200 Hz, {AXES} simulated motors that follow actions at 10 Hz. Baseline: a thread that sleeps to \
         the same grid, right before"
    );
    let note_wire = "from the publication of an action to the first command that it decided, in the adapter's line. Ten \
                     actions a second, at any phase of the cycle of 5 ms";
    Ok(vec![
        Figure::new("motors/cycle late, p50", "ms", of(&|run| run.late_ms[0])).baseline(bare(0.5)).note(note),
        Figure::new("motors/cycle late, p99.9", "ms", of(&|run| run.late_ms[1])).baseline(bare(0.999)).target("< 1"),
        Figure::new("motors/cycle late, max", "ms", of(&|run| run.late_ms[2])).baseline(bare(1.0)),
        Figure::new("motors/action to wire, p50", "ms", of(&|run| run.wire_ms[0])).target("< 1").note(note_wire),
        Figure::new("motors/action to wire, p99", "ms", of(&|run| run.wire_ms[1])),
        Figure::new("motors/200 actions a second to wire, p50", "ms", of_quick(&|run| run.wire_ms[0])).target("< 1"),
        Figure::new("motors/200 actions a second to wire, p99", "ms", of_quick(&|run| run.wire_ms[1])),
        feedback(bench.choose(1_000_000, 100_000)),
    ])
}

/// A bare thread on the same grid: how late it wakes, ms.
fn beat(length: Duration) -> Sorted {
    let begun = Stamp::now();
    let mut due = begun;
    let mut late = Vec::new();
    while due.since(begun) < length {
        due = due.after(CYCLE);
        sleep_until(due);
        late.push(Stamp::now().since(due).as_secs_f64() * 1e3);
    }
    Sorted::new(late)
}

/// Drives motors for this long, with an action about every `period`.
fn drive(length: Duration, period: Duration) -> Result<Punctuality, Failure> {
    let adapter = Adapter::plug(AXES);
    let link = Link::open_damiao(&adapter.path)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let bus = Bus::open(&disarm::registry()?, Some(&format!("motors-{}", std::process::id())))?;
    let writer = bus.writer(TopicId::Action).ok_or("the bus has no actions")?;
    let mut motors = Motors::start(link, &spec(AXES))?;
    motors.follow(bus.actions().ok_or("the bus has no actuator")?);
    motors.order(Order::Arm)?;
    let ends = Arc::new(AtomicBool::new(false));
    let publisher = std::thread::spawn({
        let ends = Arc::clone(&ends);
        move || publish(&writer, period, &ends)
    });
    let read = runtime.block_on(async {
        let begun = Instant::now();
        while begun.elapsed() < length + LIMIT {
            black_box(motors.read().await?.bytes.len());
            if begun.elapsed() >= length && adapter.count("motor_enabled") >= usize::from(AXES) {
                break;
            }
        }
        Ok::<(), Failure>(())
    });
    ends.store(true, Ordering::Release);
    publisher.join().map_err(|_| "the publisher panicked")?;
    read?;
    let enabled = adapter.count("motor_enabled");
    let punctuality = motors.finish().ok_or("thread `control` panicked")?;
    if enabled < usize::from(AXES) || punctuality.actions == 0 {
        return Err(format!("{enabled} of {AXES} motors were armed, {} actions sent", punctuality.actions).into());
    }
    Ok(punctuality)
}

/// Publishes an action every `period`, up to a tenth later, so that it occurs at every phase of the motors' cycle.
fn publish(writer: &Writer, period: Duration, ends: &AtomicBool) {
    let begun = Instant::now();
    let mut random = Random::new(1, 0);
    let mut due = Stamp::now();
    for seq in 0.. {
        if ends.load(Ordering::Acquire) {
            return;
        }
        let angle = begun.elapsed().as_secs_f64().sin() * 0.5;
        let payload = angle.to_le_bytes().repeat(usize::from(AXES));
        let header =
            SampleHeader { seq, capture_ns: Stamp::now().0, encoding: Encoding::F64 as u32, ..SampleHeader::default() };
        // A lost action is missing from the count.
        let _ = writer.publish(header, &payload);
        due = due.after(period);
        sleep_until(due.after(period.mul_f64(random.uniform(0.0, 0.1))));
    }
}

/// The cost of a motor's answer, from frame to state.
fn feedback(count: u32) -> Figure {
    let mut bus = MotorBus::new(&spec(AXES), Stamp::now());
    let mut frame =
        CanFrame { id: 0x11, len: 8, data: [0x01, 0x7f, 0xff, 0x7f, 0xf7, 0xff, 30, 30], ..CanFrame::default() };
    let begun = Instant::now();
    for number in 0..count {
        frame.data[2] = u8::try_from(number & 0xff).unwrap_or_default();
        bus.feed(black_box(&frame), Stamp(u64::from(number)));
    }
    let each = begun.elapsed().as_secs_f64() * 1e6 / f64::from(count);
    black_box(bus.counts());
    Figure::new("motors/feedback", "us", Some(each)).target("< 1").note(format!("{count} answers, decoded and judged"))
}
