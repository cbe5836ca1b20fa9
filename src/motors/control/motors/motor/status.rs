//! Is a motor on, by its own reports?
//!
//! Invariant: a motor that was ordered to turn on may be on until it reports, after an order to turn off, that it is not.
//! Invariant: one damaged frame neither lets go of a joint that is kept from falling nor keeps one from being held.

use crate::control::damiao::codec::MotorStatus;
use crate::control::motors::fault::Fault;

/// So many frames in a row make sure that a motor has turned itself off.
const SURE: u8 = 2;

#[derive(Debug, Default)]
pub(in crate::control::motors) struct Status {
    /// Since it was last ordered to turn off.
    newest: Option<MotorStatus>,
    /// Consecutive frames that report it as not enabled although it was.
    off_frames: u8,
    /// Its latched fault, once reported: the next arm clears it.
    named: Option<MotorStatus>,
    /// It was ordered or reported to be on, and has not reported off since the last disable.
    may_be_on: bool,
}

impl Status {
    /// Takes what it reports; `is_on`: it is on as far as we know, `is_ordered_off`: the order is on its way.
    pub(super) fn update(&mut self, status: MotorStatus, is_on: bool, is_ordered_off: bool) {
        let is_enabled = status == MotorStatus::Enabled;
        self.off_frames = if is_on && !is_enabled { self.off_frames.saturating_add(1) } else { 0 };
        self.newest = Some(status);
        self.named = self.named.filter(|named| *named == status);
        self.may_be_on = is_enabled || self.may_be_on && !is_ordered_off;
    }

    /// It is ordered to turn off: what it reported before does not answer this.
    pub(super) const fn order_off(&mut self) {
        self.newest = None;
    }

    /// It is ordered to turn on.
    pub(super) const fn order_on(&mut self) {
        self.may_be_on = true;
    }

    /// What it reported since it was last ordered to turn off.
    pub(super) const fn newest(&self) -> Option<MotorStatus> {
        self.newest
    }

    pub(super) fn is_enabled(&self) -> bool {
        self.newest == Some(MotorStatus::Enabled)
    }

    /// It has reported that it is not enabled since it was ordered to turn off.
    pub(super) fn is_off(&self) -> bool {
        self.newest.is_some_and(|status| status != MotorStatus::Enabled)
    }

    /// It was ordered or reported to be on, and has not reported off since the last disable.
    pub(in crate::control::motors) const fn may_be_on(&self) -> bool {
        self.may_be_on
    }

    /// Will it follow a command? It reports that it is enabled, or a single frame reports that it is not.
    pub(super) fn may_follow(&self) -> bool {
        self.is_enabled() || (1..SURE).contains(&self.off_frames)
    }

    /// What is wrong with a motor that should be enabled (`is_on`), or disabled. One that is kept from falling must not be let
    /// go for a single frame (`is_kept`).
    pub(super) fn fault(&self, motor: usize, is_on: bool, is_kept: bool) -> Option<Fault> {
        match self.newest? {
            _ if is_kept && self.off_frames < SURE => None,
            MotorStatus::Disabled if is_on => Some(Fault::Dropped { motor }),
            MotorStatus::Enabled | MotorStatus::Disabled => None,
            status => Some(Fault::Latched { motor, status }),
        }
    }

    /// A latched fault that no operator was told of yet, who is told of it now.
    pub(super) fn name(&mut self) -> Option<MotorStatus> {
        let status = self.newest.filter(|status| status.is_fault())?;
        (self.named.replace(status) != Some(status)).then_some(status)
    }

    /// Was the operator told of this one?
    pub(super) fn is_named(&self, status: MotorStatus) -> bool {
        self.named == Some(status)
    }
}
