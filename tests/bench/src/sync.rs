//! The cost of an observation, with rings as full as in a session.

use std::hint::black_box;
use std::time::{Duration, Instant};

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Epoch, SampleHeader};
use rapid_core::sync::{SyncModality, SyncSample, Synchronizer, WhenStale};
use rapid_core::time::Stamp;

use crate::figure::Figure;
use crate::stats::{Sorted, median, range};
use crate::{Bench, Failure};

/// Numbers of modalities in an observation.
const COUNTS: [u8; 3] = [4, 16, 64];
/// Rates of the modalities in turn, Hz, and capacities of their rings: the recorder keeps the topic's depth plus 1024.
const RATES: [(u64, usize); 4] = [(30, 60 + 1024), (60, 120 + 1024), (60, 120 + 1024), (1000, 2048 + 1024)];
/// Half width of the window.
const WINDOW: Duration = Duration::from_millis(25);
/// Delay of a tick's evaluation, as in the recorder.
const BEHIND: Duration = Duration::from_millis(125);
/// Time between ticks at 30 Hz.
const TICK_NS: u64 = 33_333_333;
const SECOND_NS: u64 = 1_000_000_000;

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let ticks = bench.choose(2_000, 200);
    let mut figures = Vec::new();
    let mut costs = Vec::new();
    for count in COUNTS {
        bench.progress(&format!("sync: {count} modalities"));
        let mut runs = Vec::new();
        let mut scans = Vec::new();
        for _ in 0..bench.runs {
            let (cost, scan) = one(count, ticks)?;
            runs.push(cost);
            scans.push(scan);
        }
        let (least, most) = range(&runs).unwrap_or_default();
        let figure = Figure::new(format!("sync/observation of {count}"), "us", median(&runs))
            .baseline(median(&scans))
            .note(format!("{least:.2} to {most:.2} over {} runs", runs.len()));
        figures.push(match count {
            4 => figure.target("< 20").note(
                "one of four modalities at 1 kHz, rings full; baseline: the nearest by a scan of as many headers in a row",
            ),
            _ => figure,
        });
        costs.push(median(&runs).unwrap_or_default());
    }
    let [four, .., many] = costs[..] else { return Ok(figures) };
    figures.push(
        Figure::new("sync/growth from 4 to 64", "x", Some(many / four.max(f64::MIN_POSITIVE)))
            .baseline(Some(16.0))
            .note("baseline: linear growth; a little more is what caches cost"),
    );
    Ok(figures)
}

/// Median cost of an observation and of a scan, us.
fn one(count: u8, ticks: u64) -> Result<(f64, f64), Failure> {
    let ids = (0..count).map(|bit| ModalityId::new(bit).ok_or("a bit over 63")).collect::<Result<Vec<_>, _>>()?;
    let rate = |place: usize| RATES[place % RATES.len()];
    let modalities: Vec<SyncModality> = ids
        .iter()
        .enumerate()
        .map(|(place, id)| SyncModality {
            id: *id,
            when_stale: WhenStale::Hold,
            capacity: rate(place).1,
            latency: Duration::ZERO,
        })
        .collect();
    let mut sync = Synchronizer::new(&modalities, WINDOW);
    let mut pushed = vec![0_u64; ids.len()];
    // Long enough that every ring has wrapped around.
    let start = 60 * SECOND_NS;
    let mut observations = Vec::new();
    let mut headers: Vec<Vec<SampleHeader>> =
        (0..ids.len()).map(|place| vec![SampleHeader::default(); rate(place).1]).collect();
    let mut scans = Vec::new();
    for tick in 0..ticks {
        let tick_at = Stamp(start + tick * TICK_NS);
        let now = tick_at.after(BEHIND);
        for (place, id) in ids.iter().enumerate() {
            let (hz, capacity) = rate(place);
            while pushed[place] * SECOND_NS / hz <= now.0 {
                let seq = pushed[place];
                let capture = Stamp(seq * SECOND_NS / hz);
                sync.push(*id, SyncSample { capture, recv: capture, seq, epoch: Epoch(1), keep: () });
                headers[place][usize::try_from(seq)? % capacity] =
                    SampleHeader { seq, capture_ns: capture.0, recv_ns: capture.0, ..SampleHeader::default() };
                pushed[place] += 1;
            }
        }
        let begun = Instant::now();
        black_box(sync.observe(black_box(tick_at), now, PhysicalMask(u64::MAX)));
        observations.push(begun.elapsed().as_secs_f64() * 1e6);
        let begun = Instant::now();
        for ring in &headers {
            black_box(ring.iter().min_by_key(|header| header.capture_ns.abs_diff(black_box(tick_at.0))));
        }
        scans.push(begun.elapsed().as_secs_f64() * 1e6);
    }
    let middle = |samples: Vec<f64>| Sorted::new(samples).quantile(0.5).unwrap_or_default();
    Ok((middle(observations), middle(scans)))
}
