//! How often the recorder allocates per sample written, once it has warmed up.
//!
//! What `rapid` itself does for a sample, encoding and synchronising, must not allocate at all. The
//! `mcap` crate (0.26) allocates for every *chunk*: it keeps the index of a chunk's messages in fresh
//! vectors that grow by doubling, and the chunk's own index entry until the end of the file. With
//! 60 kB pictures that is some 26 allocations every 18 samples. That remainder is measured and bounded
//! here by chunks, not by samples.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use rapid_bus::TopicId;
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Encoding, Epoch, SampleHeader};
use rapid_core::sync::{SyncModality, SyncSample, Synchronizer, WhenStale};
use rapid_core::time::Stamp;
use rapid_episode::record::{EpisodeRequest, Recorder, RecorderConfig, Source};
use rapid_episode::{encode, schema::SampleSchema};
use rapid_registry::{CameraSpec, DeviceSpec, IdentitySpec, NodeSpec, PixelFormat, Registry, RigSpec, UsbSpec};
use rapid_status::Board;

use crate::support::allocations::allocations;

const ID: ModalityId = match ModalityId::new(0) {
    Some(id) => id,
    None => panic!("0 is a bit"),
};

#[test]
fn encoding_and_synchronising_do_not_allocate() {
    let modality = SyncModality { id: ID, when_stale: WhenStale::Hold, latency: Duration::ZERO, capacity: 100 };
    let mut sync = Synchronizer::new(&[modality], Duration::from_millis(25));
    let mut out = Vec::new();
    let payload = vec![7; 60_000];
    let mut once = |n: u64| {
        let at = Stamp(n * 33_000_000);
        let header = SampleHeader { seq: n, capture_ns: at.0, encoding: Encoding::Mjpeg as u32, ..Default::default() };
        encode::sample(&mut out, SampleSchema::for_sample(&header, &payload), at.0, "cam", &header, &payload);
        sync.push(ID, SyncSample { capture: at, recv: at, seq: n, epoch: Epoch(1), keep: () });
        encode::mask(&mut out, at.0, PhysicalMask(1), n);
        let observation = sync.observe(at, at, PhysicalMask(1));
        assert!(observation.slots[0].valid);
        encode::frame(&mut out, at.0, n, observation);
    };
    (0..3).for_each(&mut once);
    assert_eq!(allocations(|| (3..1003).for_each(&mut once)), 0);
}

const SAMPLES: u64 = 2000;
const WARM_UP: u64 = 200;
const BYTES: usize = 60_000;
/// The recorder's chunk size.
const CHUNK: u64 = 1 << 20;

/// Hands over one sample a turn, counting what taking it allocates.
struct Camera {
    begun: mpsc::Receiver<()>,
    begin: Option<Stamp>,
    seq: u64,
    payload: Vec<u8>,
    allocations: Arc<AtomicU64>,
    quiet: Arc<AtomicU64>,
    done: Arc<AtomicU64>,
}

impl Source for Camera {
    fn wait(&mut self, _: Duration) -> Result<(), String> {
        if self.begin.is_none() && self.begun.try_recv().is_ok() {
            self.begin = Some(Stamp::now());
        }
        Ok(())
    }

    fn drain(&mut self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String> {
        if self.begin.is_none() || self.seq == SAMPLES {
            return Ok(());
        }
        let now = Stamp::now().0;
        let encoding = Encoding::Mjpeg as u32;
        let header =
            SampleHeader { seq: self.seq, capture_ns: now, recv_ns: now, epoch: 1, encoding, ..Default::default() };
        let allocated = allocations(|| take(TopicId::Modality(ID), &header, &self.payload));
        if self.seq >= WARM_UP {
            self.allocations.fetch_add(allocated, Ordering::Relaxed);
            self.quiet.fetch_add(u64::from(allocated == 0), Ordering::Relaxed);
        }
        self.seq += 1;
        self.done.store(self.seq, Ordering::Release);
        Ok(())
    }
}

#[tokio::test]
async fn only_chunks_allocate() {
    let device = DeviceSpec {
        name: "cam".to_owned(),
        id: ID,
        identity: IdentitySpec::Usb(UsbSpec { vid: 1, pid: 1, serial: None, port: None }),
        node: NodeSpec::Camera(CameraSpec {
            width: 640,
            height: 480,
            fps: 30,
            format: PixelFormat::Mjpg,
            depth_unit_um: 1000,
            controls: Vec::new(),
        }),
        topic: "/cam".to_owned(),
        mount: None,
        stall_after: Duration::from_millis(500),
        max_bytes: BYTES,
        depth: 64,
        when_stale: WhenStale::Hold,
        latency: Duration::ZERO,
        form: None,
        action: None,
        hooks: rapid_registry::Hooks::default(),
        verdict: rapid_registry::VerdictSpec::defaults(
            rapid_core::modality::ModalityKind::Image,
            Duration::from_millis(500),
            Some(30.0),
        ),
    };
    let rig = RigSpec {
        name: "rig".to_owned(),
        observation_hz: 30.0,
        sync_window: Duration::from_millis(25),
        cooldown: Duration::from_secs(2),
        memory_budget: 1 << 29,
        disk_reserve: None,
        expect: Vec::new(),
    };
    let registry = Arc::new(Registry {
        inference: rapid_registry::InferenceSpec::default(),
        export: rapid_registry::ExportSpec::default(),
        rig,
        devices: vec![device],
        modules: Vec::new(),
        stops: Vec::new(),
        buttons: Vec::new(),
        path: None,
        text: String::new(),
    });
    let board = Arc::new(Board::new(&registry));
    let (starter, begun) = mpsc::channel();
    let [allocations, quiet, done] = std::array::from_fn(|_| Arc::new(AtomicU64::new(0)));
    let source = Camera {
        begun,
        begin: None,
        seq: 0,
        payload: vec![0x5a; BYTES],
        allocations: Arc::clone(&allocations),
        quiet: Arc::clone(&quiet),
        done: Arc::clone(&done),
    };
    let folder = tempfile::tempdir().unwrap();
    let mut recorder = Recorder::spawn(source, RecorderConfig::new(registry, board)).unwrap();
    let request = EpisodeRequest { out: folder.path().to_owned(), task: "alloc".to_owned(), ..Default::default() };
    recorder.start(request).await.unwrap();
    starter.send(()).unwrap();
    while done.load(Ordering::Acquire) < SAMPLES {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let report = recorder.stop().await.unwrap();
    assert_eq!(report.error, None);
    assert!(report.bytes > SAMPLES * BYTES as u64);

    let samples = SAMPLES - WARM_UP;
    let file = std::fs::read(&report.file).unwrap();
    let chunks = mcap::Summary::read(&file).unwrap().unwrap().chunk_indexes.len() as u64;
    assert!(chunks >= SAMPLES * BYTES as u64 / (2 * CHUNK), "{chunks}");
    let allocated = allocations.load(Ordering::Relaxed);
    let quiet = quiet.load(Ordering::Relaxed);
    // Measured with 18 samples a chunk: 23 where a chunk ends and the next begins, and one each time
    // the vector of the chunk's message index doubles (after 1, 4, 8 and 16 messages). Every other
    // sample: none.
    assert!(allocated <= chunks * 32, "{allocated} allocations for {samples} samples in {chunks} chunks");
    assert!(quiet >= samples - chunks * 6, "{quiet} of {samples} samples without an allocation");
}
