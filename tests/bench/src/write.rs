//! The recorder's write rate, fed from memory, compared with the `mcap` crate alone on the same messages; and the cost
//! and savings of compression.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use mcap::{Compression, WriteOptions};
use rapid_bus::TopicId;
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;
use rapid_episode::record::{EpisodeRequest, Recorder, RecorderConfig, Sink, Source};
use rapid_status::Board;

use crate::child::{self, Plain, process_cpu_s, thread_cpu_s};
use crate::feed::{self, Feed, Lane};
use crate::figure::Figure;
use crate::stats::median;
use crate::{Bench, Failure};

/// Messages passed at once: more than accumulate in a few ms of the full load.
const BATCH: usize = 64;
/// Chunk sizes that are measured.
const CHUNKS_KIB: [u64; 4] = [128, 256, 512, 1024];
/// Size of the sets that are compressed, bytes.
const SET_BYTES: usize = 64 << 20;
const QUICK_SET_BYTES: usize = 16 << 20;

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let feed = Feed::full_load()?;
    let seconds = bench.length(30, 5).as_secs();
    let (mut own, mut plain) = (Vec::new(), Vec::new());
    for run in 0..bench.runs {
        bench.progress(&format!("write: run {} of {}", run + 1, bench.runs));
        // Alternates which one finds a clean disk first.
        if run % 2 == 0 {
            own.push(recorder(bench, &feed, seconds)?);
            plain.push(mcap_alone(bench.scratch.path(), &feed, seconds, child::options())?);
        } else {
            plain.push(mcap_alone(bench.scratch.path(), &feed, seconds, child::options())?);
            own.push(recorder(bench, &feed, seconds)?);
        }
    }
    let bytes = (feed.bytes() * seconds) as f64;
    let rate = |taken: &[Taken]| median(&taken.iter().map(|taken| bytes / taken.wall_s / 1e6).collect::<Vec<_>>());
    let cpu = |taken: &[Taken]| median(&taken.iter().map(|taken| taken.cpu_s / bytes * 1e9).collect::<Vec<_>>());
    let shares: Vec<f64> = own.iter().zip(&plain).map(|(own, plain)| plain.wall_s / own.wall_s).collect();
    let work: Vec<f64> = own.iter().zip(&plain).map(|(own, plain)| plain.cpu_s / own.cpu_s).collect();
    let note = format!(
        "{seconds} s of the full load ({:.0} MB) from memory to a file, the disk not waited for; baseline: mcap crate alone",
        bytes / 1e6
    );
    let mut figures = vec![
        Figure::new("write/rate", "MB/s", rate(&own)).baseline(rate(&plain)).note(note),
        Figure::new("write/rate, share of baseline", "x", median(&shares)).target(">= 0.9"),
        Figure::new("write/cpu", "s/GB", cpu(&own)).baseline(cpu(&plain)),
        Figure::new("write/work per cpu second, share of baseline", "x", median(&work)),
    ];
    figures.extend(chunks(bench, &feed, seconds)?);
    figures.extend(compression(bench)?);
    Ok(figures)
}

/// Resources used by a run.
#[derive(Debug, Clone, Copy)]
struct Taken {
    wall_s: f64,
    cpu_s: f64,
}

/// The file, without waiting for the disk at the end.
struct Unsynced(File);

impl Write for Unsynced {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Sink for Unsynced {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Passes the feed as fast as it is accepted.
struct Fed {
    feed: Feed,
    left: usize,
    numbers: Vec<u64>,
    start: Receiver<()>,
    begun: Option<(Instant, f64)>,
    done: Sender<Taken>,
}

impl Source for Fed {
    fn wait(&mut self, _: Duration) -> Result<(), String> {
        if self.begun.is_none() && self.start.try_recv().is_ok() {
            self.begun = Some((Instant::now(), thread_cpu_s()));
        }
        if self.begun.is_none() || self.left == 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }

    fn drain(&mut self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String> {
        let Some((begun, cpu)) = self.begun else { return Ok(()) };
        if self.left == 0 {
            return Ok(());
        }
        for _ in 0..BATCH.min(self.left) {
            let second = &self.feed.second;
            let place = second[(second.len() - self.left % second.len()) % second.len()];
            let lane = &self.feed.lanes[place];
            let seq = self.numbers[place];
            let now = Stamp::now().0;
            let header = SampleHeader { seq, capture_ns: now, recv_ns: now, ..lane.header };
            let payload = &lane.payloads[usize::try_from(seq).unwrap_or(0) % lane.payloads.len()];
            take(lane.topic, &header, payload);
            self.numbers[place] += 1;
            self.left -= 1;
        }
        if self.left == 0 {
            let taken = Taken { wall_s: begun.elapsed().as_secs_f64(), cpu_s: thread_cpu_s() - cpu };
            // There is no receiver if the recorder ended early.
            let _ = self.done.send(taken);
        }
        Ok(())
    }
}

fn recorder(bench: &Bench, feed: &Feed, seconds: u64) -> Result<Taken, Failure> {
    let (registry, _) = feed::rig()?;
    let registry = Arc::new(registry);
    let board = Arc::new(Board::new(&registry));
    let (go, start) = channel();
    let (done, taken) = channel();
    let left = feed.second.len() * usize::try_from(seconds)?;
    let numbers = vec![0; feed.lanes.len()];
    let source = Fed { feed: feed.clone(), left, numbers, start, begun: None, done };
    let config =
        RecorderConfig { sink: Box::new(|file| Box::new(Unsynced(file))), ..RecorderConfig::new(registry, board) };
    let mut recorder = Recorder::spawn(source, config)?;
    let out = tempfile::Builder::new().prefix("write").tempdir_in(bench.scratch.path())?;
    let runtime = tokio::runtime::Builder::new_current_thread().build()?;
    let request = EpisodeRequest { out: out.path().to_owned(), task: "write".to_owned(), ..EpisodeRequest::default() };
    runtime.block_on(recorder.start(request))?;
    go.send(())?;
    let taken = taken.recv_timeout(Duration::from_secs(600))?;
    let report = runtime.block_on(recorder.stop()).ok_or("no episode was recorded")?;
    let wanted = left as u64;
    if report.error.is_some() || report.dropped > 0 || report.messages < wanted {
        return Err(format!("{} of {wanted} messages written, {:?}", report.messages, report.error).into());
    }
    Ok(taken)
}

fn mcap_alone(folder: &Path, feed: &Feed, seconds: u64, options: WriteOptions) -> Result<Taken, Failure> {
    let path = folder.join("alone.mcap");
    let (begun, cpu) = (Instant::now(), thread_cpu_s());
    let mut plain = Plain::create(&path, feed, options)?;
    for _ in 0..seconds {
        for lane in feed.second.iter() {
            plain.write(feed, *lane)?;
        }
    }
    let taken = Taken { wall_s: begun.elapsed().as_secs_f64(), cpu_s: thread_cpu_s() - cpu };
    plain.finish()?;
    std::fs::remove_file(path)?;
    Ok(taken)
}

/// The effect of chunk size on the crate's own rate: a chunk that fits into a core's cache is cheaper to pass on, and
/// the writer is away from its queue for a shorter time.
fn chunks(bench: &Bench, feed: &Feed, seconds: u64) -> Result<Vec<Figure>, Failure> {
    let mut runs: [Vec<f64>; CHUNKS_KIB.len()] = Default::default();
    for run in 0..bench.runs {
        bench.progress(&format!("write: chunks, run {} of {}", run + 1, bench.runs));
        for (kib, taken) in CHUNKS_KIB.into_iter().zip(&mut runs) {
            let options = child::options().chunk_size(Some(kib << 10));
            let bytes = (feed.bytes() * seconds) as f64;
            taken.push(bytes / mcap_alone(bench.scratch.path(), feed, seconds, options)?.cpu_s / 1e6);
        }
    }
    let figures = CHUNKS_KIB
        .into_iter()
        .zip(&runs)
        .map(|(kib, runs)| Figure::new(format!("write/mcap crate, chunks of {kib} KiB"), "MB/cpu s", median(runs)));
    Ok(figures.collect())
}

/// The result of each codec for each kind of content.
fn compression(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let bytes = bench.choose(SET_BYTES, QUICK_SET_BYTES);
    let sets = [("JPEG", lane_of(jpeg())), ("YUYV", lane_of(yuyv())), ("scalars", lane_of(scalars()))];
    let codecs = [("none", None), ("lz4", Some(Compression::Lz4)), ("zstd", Some(Compression::Zstd))];
    let mut figures = Vec::new();
    for (kind, feed) in &sets {
        let mut plain_rate = None;
        for (codec, compression) in codecs {
            bench.progress(&format!("write: {kind}, {codec}"));
            let runs = (0..bench.runs.min(3))
                .map(|_| compress(bench.scratch.path(), feed, compression, bytes))
                .collect::<Result<Vec<_>, _>>()?;
            let of = |value: fn(&Compressed) -> f64| median(&runs.iter().map(value).collect::<Vec<_>>());
            let rate = of(|run| run.content / run.wall_s / 1e6);
            let kept = of(|run| 100.0 * run.file / run.content).unwrap_or_default();
            let cpu = of(|run| run.cpu_s / run.content * 1e9).unwrap_or_default();
            plain_rate = plain_rate.or(rate);
            figures.push(
                Figure::new(format!("write/{kind}, {codec}"), "MB/s", rate)
                    .baseline(plain_rate)
                    .note(format!("{kept:.1} % of the bytes, {cpu:.2} CPU s/GB")),
            );
        }
    }
    Ok(figures)
}

#[derive(Debug)]
struct Compressed {
    content: f64,
    file: f64,
    wall_s: f64,
    cpu_s: f64,
}

fn compress(folder: &Path, feed: &Feed, codec: Option<Compression>, least: usize) -> Result<Compressed, Failure> {
    let path = folder.join("compressed.mcap");
    let lengths: Vec<usize> = feed.lanes[0].messages.iter().map(Vec::len).collect();
    let (begun, cpu) = (Instant::now(), process_cpu_s());
    let mut plain = Plain::create(&path, feed, child::options().compression(codec))?;
    let mut content = 0;
    for length in lengths.iter().cycle() {
        if content >= least {
            break;
        }
        plain.write(feed, 0)?;
        content += length;
    }
    plain.finish()?;
    // Codecs may use threads of their own: process time, not thread time.
    let (wall_s, cpu_s) = (begun.elapsed().as_secs_f64(), process_cpu_s() - cpu);
    let file = std::fs::metadata(&path)?.len() as f64;
    std::fs::remove_file(path)?;
    Ok(Compressed { content: content as f64, file, wall_s, cpu_s })
}

/// Pictures of 60 kB that do not compress, like an encoder's output; more than a chunk holds.
fn jpeg() -> Vec<Vec<u8>> {
    let mut noise = Noise(5);
    (0..64).map(|_| (0..60_000).map(|_| noise.below(256).to_le_bytes()[0]).collect()).collect()
}

fn lane_of(messages: Vec<Vec<u8>>) -> Feed {
    let lane = Lane {
        topic: TopicId::Mask,
        name: "/set".to_owned(),
        schema: rapid_episode::schema::SampleSchema::Bytes,
        header: SampleHeader::default(),
        payloads: messages.clone(),
        messages,
        hz: 1,
    };
    Feed { lanes: Arc::new(vec![lane]), second: Arc::default() }
}

/// Raw pictures of 640x480: soft shades and a hard edge, with sensor noise of up to two steps.
fn yuyv() -> Vec<Vec<u8>> {
    const WIDTH: usize = 640;
    const HEIGHT: usize = 480;
    let mut noise = Noise(7);
    (0..8)
        .map(|picture| {
            let mut bytes = Vec::with_capacity(WIDTH * HEIGHT * 2);
            for y in 0..HEIGHT {
                for x in 0..WIDTH {
                    let edge = if (x + picture * 16) % 320 < 160 { 60 } else { 0 };
                    let luminance = 40 + edge + x / 8 + y / 8 + noise.below(5);
                    let chroma = 118 + y / 32 + noise.below(3);
                    bytes.extend([luminance, chroma].map(|value| u8::try_from(value).unwrap_or(u8::MAX)));
                }
            }
            bytes
        })
        .collect()
}

/// Vectors of 14 values like those of a motor controller: slow curves with noise in the low digits.
fn scalars() -> Vec<Vec<u8>> {
    let mut noise = Noise(11);
    (0..4096_u32)
        .map(|sample| {
            (0..14_u32)
                .flat_map(|channel| {
                    let phase = f64::from(sample) / 1000.0 + f64::from(channel);
                    (phase.sin() + noise.below(1000) as f64 * 1e-6).to_le_bytes()
                })
                .collect()
        })
        .collect()
}

/// xorshift64 (Marsaglia 2003).
struct Noise(u64);

impl Noise {
    fn below(&mut self, bound: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 >> 33).unwrap_or(0) % bound.max(1)
    }
}
