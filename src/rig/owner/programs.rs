//! What the owner has to do with programs and with episodes.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;

use super::Rig;
use crate::interlocks::tap::Tap;
use crate::modality::ModalityId;
use crate::permission::Permission;
use crate::registry::Attachment;
use crate::status::EpisodeWatch;

impl Rig {
    /// Tells devices and their hooks of episodes from now on.
    #[must_use]
    pub fn following(mut self, episode: EpisodeWatch) -> Self {
        self.episode = episode;
        self
    }

    /// Its actuator moves as `permission` says; without this nothing arms it.
    #[must_use]
    pub fn obeying(mut self, permission: &Arc<Permission>) -> Self {
        for controls in self.modalities.iter_mut().filter_map(|modality| modality.controls.as_mut()) {
            controls.obey(permission);
        }
        self
    }

    /// Samples of its devices are looked at for these emergency stops and enabling switches.
    #[must_use]
    pub fn tapped(mut self, taps: &[Tap]) -> Self {
        for modality in &mut self.modalities {
            modality.taps = taps.iter().filter(|tap| tap.device() == modality.spec.name).cloned().collect();
        }
        self
    }

    /// Cancelled by [`Self::run`] before it closes the first device at its end.
    #[must_use]
    pub fn ending(&self) -> CancellationToken {
        self.ending.clone()
    }

    /// Cancelled, it kills the programs that are being ended.
    #[must_use]
    pub fn hurry(&self) -> CancellationToken {
        self.programs.as_ref().map_or_else(CancellationToken::new, |programs| programs.hurry.clone())
    }

    /// After a run and the episode in it, waits for the programs of its devices, which it told to end,
    /// and for their hooks.
    pub async fn programs_ended(&self) {
        if let Some(programs) = &self.programs {
            programs.ended().await;
        }
    }

    pub(super) fn attend(&mut self, id: ModalityId, attachment: &Attachment) {
        let episode = self.episode.clone();
        if let Some(post) = self.modality(id).and_then(|modality| modality.post.as_mut()) {
            post.attached(attachment, &episode);
        }
    }

    pub(super) fn dismiss(&mut self, id: ModalityId) {
        if let Some(post) = self.modality(id).and_then(|modality| modality.post.as_ref()) {
            post.removed();
        }
    }
}
