//! From an observation to a chunk of actions, compared with onnxruntime alone on the same graphs.
//!
//! The two alternate, one chunk each, so that other load on the machine affects both.

use std::hint::black_box;
use std::time::Instant;

use rapid_core::random::Random;
use rapid_core::sample::SampleHeader;
use rapid_policy::bundle::{Bundle, Graph};
use rapid_policy::graphs::{BoundGraph, LoadedGraph};
use rapid_policy::model::Model;
use rapid_policy::observation::ObservationTensors;
use rapid_policy::onnxruntime::Environment;
use rapid_policy::request::Request;
use rapid_policy::sampler::{Computing, Sampler};
use rapid_registry::InferenceSpec;
use rapid_registry::simulation::task::{Expert, Trial, layout};
use rapid_registry::task::PARTS;

use crate::child::thread_cpu_s;
use crate::figure::Figure;
use crate::start::ms;
use crate::stats::Sorted;
use crate::{Bench, Failure, eager, heap};

/// Chunks before the first one that is measured.
const WARM_UP: usize = 20;
/// The trial and the step that are observed: on the way to the block.
const SEED: u64 = 50_000;
const STEPS: usize = 20;

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let bundle = Bundle::load(&bench.bundle)?;
    let mut subject = Subject::load(&bundle)?;
    let chunks = bench.choose(500, 40);
    bench.progress(&format!("policy: {chunks} chunks"));
    let seen = subject.run(chunks)?;
    let p50 = |samples: &[f64]| Sorted::new(samples.iter().copied()).quantile(0.5);
    let p99 = |samples: &[f64]| Sorted::new(samples.iter().copied()).quantile(0.99);
    let ratio = |ours: &[f64]| p50(&ours.iter().zip(&seen.bare).map(|(ours, bare)| ours / bare).collect::<Vec<_>>());
    let work = p50(&seen.sampler_cpu.iter().zip(&seen.bare_cpu).map(|(ours, bare)| ours / bare).collect::<Vec<_>>());
    let note = format!(
        "{chunks} times, one thread, {} steps of denoising: {} pictures and states of the simulated task, decoded, \
         compared, normalised, and the sampler; baseline: onnxruntime alone, the encoder once and the denoiser {} times \
         on memory that is filled already",
        subject.sampler.steps(),
        bundle.observations.iter().map(|observation| bundle.steps_of(observation)).sum::<usize>(),
        subject.sampler.steps()
    );
    let mut figures = vec![
        Figure::new("policy/observation to chunk, p50", "ms", p50(&seen.answer)).baseline(p50(&seen.bare)).note(note),
        Figure::new("policy/observation to chunk, p99", "ms", p99(&seen.answer)).baseline(p99(&seen.bare)),
        Figure::new("policy/of it observation, p50", "ms", p50(&seen.observe)).note("from a filled request to tensors"),
        Figure::new("policy/of it sampler, p50", "ms", p50(&seen.sampler)).baseline(p50(&seen.bare)),
        Figure::new("policy/of it sampler, cpu p50", "ms", p50(&seen.sampler_cpu))
            .baseline(p50(&seen.bare_cpu))
            .note("the thread's own time: what another program takes does not count"),
        Figure::new("policy/sampler, multiple of baseline", "x", ratio(&seen.sampler))
            .target("<= 1.05")
            .note("the median of pairs, by the clock on the wall"),
        Figure::new("policy/sampler, multiple of baseline, cpu", "x", work).note("the same by the thread's own time"),
        Figure::new("policy/observation to chunk, multiple of baseline", "x", ratio(&seen.answer)),
    ];
    figures.extend(eager::figures(bench, || subject.run(chunks / 2).map(|seen| (seen.sampler, seen.sampler_cpu))));
    figures.push(heap::figure(bench).unwrap_or_else(|error| Figure::of_failure("policy/heap", &error)));
    Ok(figures)
}

/// The policy, and the bare graphs.
struct Subject {
    model: Model,
    /// The parts of an answer.
    observer: Model,
    sampler: Sampler,
    bare: Bare,
    request: Request,
    chunk: Vec<f32>,
}

/// The durations, ms.
#[derive(Default)]
struct Seen {
    answer: Vec<f64>,
    observe: Vec<f64>,
    sampler: Vec<f64>,
    bare: Vec<f64>,
    sampler_cpu: Vec<f64>,
    bare_cpu: Vec<f64>,
}

impl Subject {
    fn load(bundle: &Bundle) -> Result<Self, Failure> {
        let environment = Environment::open(None)?;
        let mut observer = Model::load(bundle, &environment, Computing::default())?;
        let request = request(bundle)?;
        let sampler = Sampler::new(bundle, &environment, Computing::default())?;
        let bare = Bare::load(bundle, &environment, observer.observe(&request)?, sampler.steps())?;
        let chunk = vec![0.0; sampler.chunk_len()];
        Ok(Self {
            model: Model::load(bundle, &environment, Computing::default())?,
            observer,
            sampler,
            bare,
            request,
            chunk,
        })
    }

    fn run(&mut self, chunks: usize) -> Result<Seen, Failure> {
        let mut seen = Seen::default();
        for number in 0..WARM_UP + chunks {
            if number == WARM_UP {
                seen = Seen::default();
            }
            // Alternates which one comes first.
            if number.is_multiple_of(2) {
                self.own(&mut seen)?;
                self.alone(&mut seen)?;
            } else {
                self.alone(&mut seen)?;
                self.own(&mut seen)?;
            }
            let begun = Instant::now();
            self.model.answer(black_box(&self.request), &mut self.chunk)?;
            seen.answer.push(ms(begun));
        }
        Ok(seen)
    }

    fn own(&mut self, seen: &mut Seen) -> Result<(), Failure> {
        let begun = Instant::now();
        let tensors = self.observer.observe(black_box(&self.request))?;
        seen.observe.push(ms(begun));
        let (begun, cpu) = (Instant::now(), thread_cpu_s());
        self.sampler.chunk(tensors, self.request.seed, &mut self.chunk)?;
        seen.sampler_cpu.push((thread_cpu_s() - cpu) * 1e3);
        seen.sampler.push(ms(begun));
        Ok(())
    }

    fn alone(&mut self, seen: &mut Seen) -> Result<(), Failure> {
        let (begun, cpu) = (Instant::now(), thread_cpu_s());
        self.bare.chunk()?;
        seen.bare_cpu.push((thread_cpu_s() - cpu) * 1e3);
        seen.bare.push(ms(begun));
        Ok(())
    }
}

/// The graphs alone, on inputs that are written once.
struct Bare {
    encoder: BoundGraph,
    denoiser: BoundGraph,
    steps: usize,
}

impl Bare {
    fn load(
        bundle: &Bundle,
        environment: &Environment,
        observation: &ObservationTensors,
        steps: usize,
    ) -> Result<Self, Failure> {
        let load = |graph: Graph| -> Result<BoundGraph, Failure> {
            let bytes = bundle.read_graph(graph)?;
            Ok(LoadedGraph::load(environment, &bundle.graph(graph).file, &bytes, InferenceSpec::default())?.bind()?)
        };
        let (mut encoder, mut denoiser) = (load(Graph::Encoder)?, load(Graph::Denoiser)?);
        for (at, spec) in bundle.observations.iter().enumerate() {
            encoder.write(encoder.input_index(&spec.key)?, observation.values(at))?;
            if let Some(history) = &spec.history {
                encoder.write(encoder.input_index(&history.valid)?, observation.valid(at))?;
            }
        }
        if let Some(mask) = &bundle.mask {
            encoder.write(encoder.input_index(&mask.input)?, observation.mask())?;
        }
        let condition = denoiser.input_index("global_cond")?;
        encoder.run(|values| denoiser.write(condition, values))??;
        let mut noise = vec![0.0; bundle.horizon * bundle.action.outputs()];
        Random::new(SEED, 0).fill_normal(&mut noise);
        denoiser.write(denoiser.input_index("sample")?, &noise)?;
        denoiser.write_integer(denoiser.input_index("timestep")?, 50)?;
        Ok(Self { encoder, denoiser, steps })
    }

    fn chunk(&mut self) -> Result<(), Failure> {
        self.encoder.run(|condition| {
            black_box(condition);
        })?;
        for _ in 0..self.steps {
            self.denoiser.run(|prediction| {
                black_box(prediction);
            })?;
        }
        Ok(())
    }
}

/// A request of the simulated task, with all modalities present.
pub(crate) fn request(bundle: &Bundle) -> Result<Request, Failure> {
    let mut request = Request::new(bundle);
    let (mut trial, mut expert) = (Trial::new(SEED), Expert::new(SEED));
    let mut payload = Vec::new();
    let steps = (0..bundle.observations.len()).map(|at| request.steps(at)).max().unwrap_or(0);
    for number in 0..STEPS + steps {
        let target = expert.act(&trial.world);
        trial.command(target);
        trial.step(0.0);
        for (at, observation) in bundle.observations.iter().enumerate() {
            // The last step of each is that of the last tick.
            let Some(step) = number.checked_sub(STEPS + steps - request.steps(at)) else { continue };
            let part = PARTS.iter().find(|(name, _)| *name == observation.modality);
            let (_, part) = part.ok_or_else(|| format!("the simulated task has no `{}`", observation.modality))?;
            trial.sample(*part, &mut payload)?;
            let (encoding, width, height) = layout(*part);
            let encoding = encoding as u32;
            let header = SampleHeader { seq: number as u64, encoding, width, height, ..SampleHeader::default() };
            request.cell_mut(at, step).ok_or("a request without its cells")?.set(&header, &payload);
            request.set_present(at, true);
        }
    }
    request.seed = SEED;
    Ok(request)
}
