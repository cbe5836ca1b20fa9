//! An episode recorded by the owner of the clock: the same code and the same file as the `writer`
//! thread's, without thread, bus and real time.
//!
//! Invariant: the moments handed in never go back.

use std::sync::Arc;

use rapid_bus::TopicId;
use rapid_core::sample::SampleHeader;
use rapid_core::time::{Stamp, WallClock};
use rapid_registry::Registry;
use rapid_status::{Board, EpisodeReport, Event};
use rapid_system::disk::FileLimit;

use super::RecordError;
use super::episode_path::{EpisodePath, EpisodeRequest};
use super::open_episode::{Beginning, OpenEpisode};
use super::provenance::Attached;
use super::streams::Streams;
use crate::chunk_writer::Sink;

/// Who sees what a rig sends, in the order of time.
pub trait Taker {
    /// A sample, a publication of the mask, or an action.
    fn receive(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8]);
    /// An event.
    fn event(&mut self, event: &Event);
}

/// What passes before an episode and during it.
pub struct Stepped {
    registry: Arc<Registry>,
    board: Arc<Board>,
    clock: WallClock,
    streams: Streams,
    attached: Attached,
    open: Option<OpenEpisode>,
}

impl std::fmt::Debug for Stepped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Stepped").field("recording", &self.open.is_some()).finish_non_exhaustive()
    }
}

impl Stepped {
    /// A recorder without an episode. `clock` converts the given moments to the wall clock.
    pub fn new(registry: Arc<Registry>, board: Arc<Board>, clock: WallClock) -> Self {
        Self { registry, board, clock, streams: Streams::new(), attached: Attached::default(), open: None }
    }

    /// Begins an episode.
    ///
    /// # Errors
    /// When its file cannot be made or written.
    pub fn begin(&mut self, request: &EpisodeRequest, begin: Stamp) -> Result<(), RecordError> {
        let path = EpisodePath::create(request, self.clock.wall_ns(begin))?;
        let partial = path.partial.clone();
        let failed = |source| RecordError::Io { path: partial.clone(), source };
        let sink: Box<dyn Sink> = Box::new(path.file.try_clone().map_err(failed)?);
        let beginning = Beginning {
            registry: Arc::clone(&self.registry),
            board: Arc::clone(&self.board),
            request,
            limit: FileLimit::of(&path.file),
            path,
            sink,
            attached: &self.attached,
            clock: self.clock,
            begin,
            shown: None,
            references: &[],
        };
        self.open = Some(OpenEpisode::begin(beginning, &self.streams.masks).map_err(failed)?);
        Ok(())
    }

    /// Writes what is due by `now`.
    pub fn advance(&mut self, now: Stamp) {
        if let Some(open) = &mut self.open {
            open.advance(now, &self.streams.masks);
        }
    }

    /// Ends the episode with what was captured before `end`; `None` if there is none.
    pub fn finish(&mut self, end: Stamp) -> Option<EpisodeReport> {
        let mut open = self.open.take()?;
        open.end_at(end);
        Some(open.finish(end, &self.streams.masks, None, &[]))
    }
}

impl Taker for Stepped {
    fn receive(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8]) {
        self.streams.receive(self.open.as_mut(), topic, header, payload);
    }

    fn event(&mut self, event: &Event) {
        self.attached.apply(event);
        if let Some(open) = &mut self.open {
            open.event(event);
        }
    }
}
