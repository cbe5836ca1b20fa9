//! The cost of pictures on their way into a policy, and of those of the simulated task.

use std::hint::black_box;
use std::time::Instant;

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use rapid_core::random::Random;
use rapid_core::sample::Encoding;
use rapid_pictures::jpeg::Walker;
use rapid_policy::bundle::{Bundle, ImageSpec, ObservationInput};
use rapid_policy::picture::{Picture, Preprocessor};
use rapid_registry::simulation::TaskPart;
use rapid_registry::simulation::task::{Expert, SIDE, Trial};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;

use crate::child::thread_cpu_s;
use crate::figure::Figure;
use crate::start::ms;
use crate::stats::Sorted;
use crate::{Bench, Failure};

const WIDTH: u16 = 640;
const HEIGHT: u16 = 480;
/// Approximate quality of a camera's own encoder.
const QUALITY: u8 = 80;
/// Sensor noise in a lit room, of 255; it determines the size of a picture: 50 to 60 kB.
const NOISE: f32 = 6.5;
/// Different pictures of each camera.
const FRAMES: u64 = 8;
/// Pairs before the first one that is measured.
const WARM_UP: usize = 10;
/// The quality used by `simulation/task`.
const TASK_QUALITY: u8 = 95;

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let bundle = Bundle::load(&bench.bundle)?;
    let mut figures = preprocessing(bench, &bundle)?;
    figures.push(judging(bench)?);
    figures.extend(rendering(bench)?);
    Ok(figures)
}

fn preprocessing(bench: &Bench, bundle: &Bundle) -> Result<Vec<Figure>, Failure> {
    let pairs = bench.choose(1_000, 60);
    bench.progress(&format!("picture: {pairs} pairs of pictures"));
    let mut cameras = Vec::new();
    for observation in &bundle.observations {
        let ObservationInput::Image(image) = observation.input else { continue };
        let spec = ImageSpec { resize: Some([image.height, image.width]), crop: None, ..image };
        let preprocessor = Preprocessor::new(spec, &observation.normalization);
        let frames =
            (0..FRAMES).map(|number| frame(number * 2 + cameras.len() as u64)).collect::<Result<Vec<_>, _>>()?;
        cameras.push((vec![0.0; preprocessor.output_len()], preprocessor, frames));
    }
    let bytes: Vec<usize> = cameras.iter().flat_map(|(_, _, frames)| frames).map(Vec::len).collect();
    let (mut whole, mut decoding, mut work) = (Vec::new(), Vec::new(), Vec::new());
    let mut pixels = Vec::new();
    for pair in 0..pairs + WARM_UP {
        let (begun, cpu) = (Instant::now(), thread_cpu_s());
        for (out, preprocessor, frames) in &mut cameras {
            let bytes = &frames[pair % frames.len()];
            let (width, height) = (u32::from(WIDTH), u32::from(HEIGHT));
            preprocessor.write(&Picture { encoding: Encoding::Mjpeg, width, height, bytes }, black_box(out))?;
        }
        whole.push(ms(begun));
        work.push((thread_cpu_s() - cpu) * 1e3);
        let begun = Instant::now();
        for (_, _, frames) in &cameras {
            decode(&frames[pair % frames.len()], &mut pixels)?;
        }
        decoding.push(ms(begun));
    }
    let [whole, decoding, work] = [whole, decoding, work].map(|mut times| Sorted::new(times.split_off(WARM_UP)));
    let note = format!(
        "{pairs} times {} pictures of {WIDTH}x{HEIGHT}, {:.0} to {:.0} kB each, as the policy wants them; baseline: decoding alone",
        cameras.len(),
        bytes.iter().min().map_or(0.0, |bytes| *bytes as f64 / 1e3),
        bytes.iter().max().map_or(0.0, |bytes| *bytes as f64 / 1e3)
    );
    Ok(vec![
        Figure::new("picture/of all cameras to tensors, p50", "ms", whole.quantile(0.5))
            .baseline(decoding.quantile(0.5))
            .target("< 6")
            .note(note),
        Figure::new("picture/of all cameras to tensors, p99", "ms", whole.quantile(0.99))
            .baseline(decoding.quantile(0.99)),
        Figure::new("picture/of all cameras to tensors, cpu p50", "ms", work.quantile(0.5))
            .note("the thread's own time: what another program takes does not count"),
    ])
}

/// What it costs to find out whether pictures are whole, beside decoding them.
fn judging(bench: &Bench) -> Result<Figure, Failure> {
    /// Cameras, pictures a second of each, and bytes of a picture.
    const LOAD: f64 = 3.0 * 30.0 * 100e3;
    let pictures = bench.choose(2_000, 100);
    let frames = (0..FRAMES).map(|number| frame(number * 2)).collect::<Result<Vec<_>, _>>()?;
    let (mut walker, mut pixels) = (Walker::default(), Vec::new());
    let (mut walked, mut decoded) = (Vec::new(), Vec::new());
    for jpeg in frames.iter().cycle().take(pictures) {
        let share = LOAD / jpeg.len() as f64 * 100.0;
        let begun = thread_cpu_s();
        black_box(walker.walk(black_box(jpeg))?);
        let between = thread_cpu_s();
        decode(jpeg, &mut pixels)?;
        walked.push((between - begun) * share);
        decoded.push((thread_cpu_s() - between) * share);
    }
    let [walked, decoded] = [walked, decoded].map(Sorted::new);
    Ok(Figure::new("picture/judging 3 cameras of 100 kB at 30 Hz, of a core", "%", walked.quantile(0.5))
        .baseline(decoded.quantile(0.5))
        .target("<= 5")
        .note(format!("{pictures} pictures, each walked once; baseline: decoding them")))
}

fn decode(jpeg: &[u8], pixels: &mut Vec<u8>) -> Result<(), Failure> {
    let mut decoder = JpegDecoder::new(ZCursor::new(jpeg));
    decoder.decode_headers()?;
    pixels.resize(decoder.output_buffer_size().ok_or("a picture without size")?, 0);
    decoder.decode_into(pixels)?;
    black_box(pixels);
    Ok(())
}

/// A realistic camera picture: light that falls off, a few objects with edges, and sensor noise; colours at half the
/// resolution, as cameras send them.
fn frame(number: u64) -> Result<Vec<u8>, Failure> {
    let mut random = Random::new(number, 0);
    let (width, height) = (f64::from(WIDTH), f64::from(HEIGHT));
    let things: Vec<[f64; 6]> = (0..12)
        .map(|_| {
            let place = [random.uniform(0.0, width), random.uniform(0.0, height), random.uniform(20.0, 90.0)];
            let color: [f64; 3] = std::array::from_fn(|_| random.uniform(20.0, 230.0));
            [place[0], place[1], place[2], color[0], color[1], color[2]]
        })
        .collect();
    let mut pixels = Vec::with_capacity(3 * usize::from(WIDTH) * usize::from(HEIGHT));
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let (x, y) = (f64::from(x), f64::from(y));
            let light = 60.0 + 120.0 * (1.0 - (x / width - 0.4).hypot(y / height - 0.3));
            let thing = things.iter().find(|thing| (x - thing[0]).abs().max((y - thing[1]).abs()) < thing[2]);
            let shade = 0.7 + 0.3 * (x / 9.0).sin() * (y / 13.0).cos();
            let noise = NOISE * random.normal();
            for channel in 0..3 {
                let value = thing.map_or(light, |thing| thing[3 + channel] * shade);
                // A sensor clips values out of range, too.
                #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
                pixels.push((value + f64::from(noise)).clamp(0.0, 255.0) as u8);
            }
        }
    }
    let mut jpeg = Vec::new();
    let mut encoder = Encoder::new(&mut jpeg, QUALITY);
    encoder.set_sampling_factor(SamplingFactor::R_4_2_2);
    encoder.encode(&pixels, WIDTH, HEIGHT, ColorType::Rgb)?;
    Ok(jpeg)
}

fn rendering(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let trials = bench.choose(20, 3);
    bench.progress(&format!("picture: {trials} trials of the simulated task"));
    let side = u16::try_from(SIDE)?;
    let (mut whole, mut encoding) = (Vec::new(), Vec::new());
    let mut payloads = [Vec::new(), Vec::new()];
    let (mut pixels, mut again) = ([Vec::new(), Vec::new()], Vec::new());
    for seed in 0..trials {
        let (mut trial, mut expert) = (Trial::new(seed), Expert::new(seed));
        for _ in 0..100 {
            let target = expert.act(&trial.world);
            trial.command(target);
            trial.step(0.0);
            let begun = Instant::now();
            for (part, payload) in [TaskPart::Wrist, TaskPart::Tactile].into_iter().zip(&mut payloads) {
                trial.sample(part, black_box(payload))?;
            }
            whole.push(ms(begun));
            for (payload, pixels) in payloads.iter().zip(&mut pixels) {
                decode(payload, pixels)?;
            }
            let begun = Instant::now();
            for pixels in &pixels {
                again.clear();
                let mut encoder = Encoder::new(&mut again, TASK_QUALITY);
                encoder.set_sampling_factor(SamplingFactor::F_1_1);
                encoder.encode(pixels, side, side, ColorType::Rgb)?;
                black_box(&again);
            }
            encoding.push(ms(begun));
        }
    }
    let count = whole.len();
    let (whole, encoding) = (Sorted::new(whole), Sorted::new(encoding));
    let note = format!(
        "both {SIDE}x{SIDE} pictures of the simulated task, drawn and encoded, {count} times along {trials} demonstrations; \
         baseline: encoding alone"
    );
    Ok(vec![
        Figure::new("picture/simulated task, p50", "ms", whole.quantile(0.5))
            .baseline(encoding.quantile(0.5))
            .target("< 1")
            .note(note),
        Figure::new("picture/simulated task, p99", "ms", whole.quantile(0.99)).baseline(encoding.quantile(0.99)),
    ])
}
