//! What streams report, and what is told of them and of their devices, also in the file for people.

use std::sync::Arc;

use tokio::sync::mpsc;

use super::{Modality, Rig};
use crate::action::{ActuatorNotice, Arming};
use crate::driver::DriverError;
use crate::hotplug::Witness;
use crate::modality::ModalityId;
use crate::registry::Attachment;
use crate::rig::presence::JsonDevice;
use crate::rig::slot::Input;
use crate::rig::stream::{Report, Reported};
use crate::sample::Epoch;
use crate::status::{Level, SlotState, What};

impl Rig {
    /// What streams reported by now: of one that has ended, all of it.
    pub(super) fn reports_so_far(&mut self, reported: &mut mpsc::Receiver<Reported>) {
        for _ in 0..reported.len() {
            let Ok((id, epoch, report)) = reported.try_recv() else { return };
            self.report(id, epoch, report);
        }
    }

    pub(super) fn report(&mut self, id: ModalityId, epoch: Epoch, report: Report) {
        // A report may arrive after the end of its stream, whose reason must stay.
        let Some(modality) = self.modality(id).filter(|modality| modality.slot.is_current(epoch)) else { return };
        match report {
            Report::Unlinked => {
                self.tell_detach(id, Witness::Link.word());
                let Some(modality) = self.modality(id) else { return };
                let what = DriverError::Unlinked.to_string();
                let text = format!("{}: {what}; it is opened when that is over", modality.spec.name);
                modality.detail = what;
                self.show(id);
                self.board.announce(What::Log { level: Level::Warn, text });
            }
            Report::Opened(description, provenance) => {
                self.tell_attach_again(id);
                let Some(modality) = self.modality(id) else { return };
                modality.detail = description;
                let device = modality.spec.name.clone();
                self.show(id);
                self.board.announce(What::Opened { device, bit: id, provenance });
            }
            Report::Silent(limit) => {
                modality.detail = format!("{}; it has sent nothing for {} s", modality.detail, limit.as_secs());
                let text = format!("{}: open, but it has sent nothing for {} s", modality.spec.name, limit.as_secs());
                self.show(id);
                self.board.announce(What::Log { level: Level::Warn, text });
            }
            Report::Started => self.apply(id, Input::Started(epoch)),
            Report::Stalled => self.apply(id, Input::Stalled(epoch)),
            Report::Resumed => self.apply(id, Input::Resumed(epoch)),
            Report::Actuator(ActuatorNotice { arming, text, is_problem }) => {
                modality.detail = format!("{}: {text}", arming.word());
                modality.arming = Some(arming);
                let device = modality.spec.name.clone();
                self.show(id);
                self.board.announce(What::Actuator { device, bit: id, arming, is_problem, text });
            }
            Report::Refused(reason) => {
                let text = format!("{}: {reason}", modality.spec.name);
                self.board.announce(What::Log { level: Level::Error, text });
            }
        }
    }

    /// The stream of a modality has ended, or was told to. What its actuator said last is not so any more:
    /// nobody hears of it, and nothing is sent to it until the next arm.
    pub(super) fn lay_down(&mut self, id: ModalityId, is_problem: bool) {
        let board = Arc::clone(&self.board);
        let Some(modality) = self.modality(id) else { return };
        if modality.arming.take().is_none_or(|last| matches!(last, Arming::Disarmed | Arming::Faulted)) {
            return;
        }
        let (device, text) = (modality.spec.name.clone(), "it is commanded no more, until the next arm".to_owned());
        board.announce(What::Actuator { device, bit: id, arming: Arming::Disarmed, is_problem, text });
    }

    pub(super) fn tell_attach(&mut self, id: ModalityId, attachment: &Attachment) {
        let Some(modality) = self.modality(id) else { return };
        modality.was_told_gone = false;
        let what = What::Attach {
            device: modality.spec.name.clone(),
            bit: id,
            node: attachment.node.label(),
            unit: attachment.unit.clone(),
            driver: attachment.driver.as_deref().cloned(),
        };
        self.board.announce(what);
    }

    /// A device of which a removal was told, and not by hot-plug, is there again: its link is up, or it never
    /// was gone.
    pub(super) fn tell_attach_again(&mut self, id: ModalityId) {
        let Some(modality) = self.modality(id).filter(|modality| modality.was_told_gone) else { return };
        if let Some(attachment) = modality.slot.attached().cloned() {
            self.tell_attach(id, &attachment);
        }
    }

    /// Says who saw an unplug, unless another witness was first.
    pub(super) fn tell_detach(&mut self, id: ModalityId, witness: &str) {
        let Some(modality) = self.modality(id) else { return };
        if modality.slot.state() == SlotState::Absent {
            return;
        }
        modality.detail = format!("unplugged, told by {witness}");
        if !std::mem::replace(&mut modality.was_told_gone, true) {
            let (device, witness) = (modality.spec.name.clone(), witness.to_owned());
            self.board.announce(What::Detach { device, bit: id, witness });
        }
    }

    pub(super) fn announce_state(&mut self, id: ModalityId) {
        let (mask, count, board) = (self.mask, self.modalities.len(), Arc::clone(&self.board));
        let Some(modality) = self.modality(id) else { return };
        let (device, detail, state) = (modality.spec.name.clone(), modality.detail.clone(), modality.slot.state());
        board.announce(What::State { device, bit: id, state, mask: mask.hex(count), detail });
    }

    /// Writes the file for people, with mask and sequence of one publication; `false` if the mask of now is still to be
    /// published.
    pub(super) fn write_json(&self) -> bool {
        let device = |modality: &Modality| JsonDevice {
            name: modality.spec.name.clone(),
            bit: modality.spec.id,
            online: modality.slot.is_present(),
            usb_connected: modality.slot.attached().is_some(),
            state: modality.slot.state(),
        };
        let devices: Vec<_> = self.modalities.iter().map(device).collect();
        self.presence.write_json(self.mask, &devices)
    }
}
