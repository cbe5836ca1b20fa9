//! What a user wants run when something happens to a device.

use std::path::PathBuf;

/// The hooks of an entry; by default none.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Hooks {
    /// `on_attach`: the device was attached. Its node is opened meanwhile.
    pub attach: Option<Hook>,
    /// `on_detach`: it was removed, and the program that read it, if one did, has ended.
    pub detach: Option<Hook>,
    /// `on_record_start`: an episode begins, or the device was attached during one.
    pub record_start: Option<Hook>,
    /// `on_record_stop`: that episode is over, or the device was removed.
    pub record_stop: Option<Hook>,
}

/// A program and its arguments; no shell reads them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Hook {
    /// As in [`super::ProcessSpec::program`].
    pub program: PathBuf,
    /// Its arguments.
    pub args: Vec<String>,
}

impl Hooks {
    /// Each hook with its key in `devices.toml`.
    pub fn all(&self) -> impl Iterator<Item = (&'static str, &Hook)> {
        let hooks = [
            ("on_attach", &self.attach),
            ("on_detach", &self.detach),
            ("on_record_start", &self.record_start),
            ("on_record_stop", &self.record_stop),
        ];
        hooks.into_iter().filter_map(|(key, hook)| Some((key, hook.as_ref()?)))
    }

    /// Is there none?
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.all().next().is_none()
    }
}
