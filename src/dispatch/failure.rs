//! Why a command failed, and its exit code.

use std::io;
use std::path::PathBuf;

use crate::app::AppError;
use crate::commands;
use crate::commands::compare::CompareFailure;
use crate::commands::eval::EvalError;
use crate::commands::inspect::InspectFailure;
use crate::compare::CompareError;
use crate::driver::DriverError;
use crate::policy::bundle::BundleErrors;
use crate::record::RecordError;
use crate::record::inspect::InspectError;
use crate::registry::RegistryErrors;
use crate::rig::presence::PresenceError;

/// Why a command ended without having done what it was asked.
#[derive(Debug, thiserror::Error)]
pub(super) enum Failure {
    #[error(transparent)]
    App(#[from] AppError),
    /// The registry is wrong.
    #[error("{0}")]
    Registry(#[from] RegistryErrors),
    /// There is none.
    #[error(
        "no devices.toml: looked for {}\n    fix: write one (`rapid devices` lists what is plugged in), name one with --config, \
         or look around with `rapid --sim`", .0.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
    )]
    NoRegistry(Vec<PathBuf>),
    #[error(transparent)]
    Presence(#[from] PresenceError),
    #[error(transparent)]
    Hotplug(#[from] crate::hotplug::HotplugError),
    #[error(transparent)]
    Inspect(#[from] InspectError),
    #[error(transparent)]
    Artifacts(#[from] commands::artifacts::ArtifactsError),
    #[error(transparent)]
    Register(#[from] commands::register::RegisterError),
    #[error(transparent)]
    Order(#[from] commands::arm::OrderError),
    #[error(transparent)]
    Mask(#[from] commands::mask::MaskError),
    #[error(transparent)]
    Calibrate(#[from] commands::calibrate::CalibrateError),
    /// Not every file was repaired; which and why has been printed.
    #[error("")]
    Recover(commands::recover::Outcome),
    /// The episode to play is none.
    #[error(transparent)]
    Replay(DriverError),
    /// The folder for episodes cannot be written to.
    #[error(transparent)]
    Folder(RecordError),
    #[error(transparent)]
    Eval(#[from] commands::eval::EvalError),
    /// The policy is wrong, or not for this rig.
    #[error(transparent)]
    Bundle(BundleErrors),
    /// The policy inside the program, on another rig than its own.
    #[error(
        "{0}\nThe policy inside rapid is for the simulated task alone: rapid --infer --sim task\n    fix: name the folder \
         of a policy that was trained on this rig: rapid --infer FOLDER (models/README.md says how one is made)"
    )]
    OtherRig(BundleErrors),
    #[error(transparent)]
    Compare(#[from] CompareFailure),
    #[error(transparent)]
    Demonstrate(#[from] commands::demonstrate::DemonstrateError),
    #[error(transparent)]
    Module(#[from] crate::registry::ModuleError),
    #[error(transparent)]
    Ablation(#[from] commands::ablation::AblationError),
    /// What was typed makes no sense together.
    #[error("{0}")]
    Arguments(&'static str),
    /// What was wrong has been printed.
    #[error("")]
    Told,
    /// What was looked for has been found, and printed.
    #[error("")]
    Found,
    #[error("output: {0}")]
    Output(#[from] io::Error),
    /// Whatever was done has been undone on the way here.
    #[error("rapid panicked; please report this")]
    Panicked,
}

impl From<InspectFailure> for Failure {
    fn from(failure: InspectFailure) -> Self {
        match failure {
            InspectFailure::Episode(error) => Self::Inspect(error),
            InspectFailure::Output(error) => Self::Output(error),
        }
    }
}

impl Failure {
    /// Exit codes: 1 failed while running, 2 bad configuration or arguments, 3 something needed is not there, 4 a BAD
    /// episode, 130 interrupted twice.
    pub(super) fn code(&self) -> u8 {
        match self {
            Self::App(AppError::InterruptedTwice) => 130,
            Self::App(AppError::Logging(_))
            | Self::Registry(_)
            | Self::NoRegistry(_)
            | Self::Replay(_)
            | Self::Folder(_)
            | Self::Inspect(InspectError::NotMcap(_))
            | Self::Arguments(_)
            | Self::Module(_)
            | Self::Bundle(_)
            | Self::OtherRig(_)
            | Self::Eval(EvalError::Bundle(_))
            | Self::Compare(
                CompareFailure::Bundle(_)
                | CompareFailure::Compare(
                    CompareError::File(_)
                    | CompareError::Registry { .. }
                    | CompareError::Unsuited { .. }
                    | CompareError::Nothing(_),
                ),
            )
            | Self::Told => 2,
            Self::Inspect(InspectError::Io { source, .. })
                if matches!(source.kind(), io::ErrorKind::NotFound | io::ErrorKind::IsADirectory) =>
            {
                2
            }
            Self::Calibrate(error) if error.is_bad_argument() => 2,
            Self::Ablation(error) if error.is_bad_argument() => 2,
            Self::Register(error) if error.is_bad_argument() => 2,
            Self::Recover(outcome) if outcome.is_bad_argument() => 2,
            Self::App(AppError::Bad { .. }) => 4,
            Self::App(AppError::Required(_)) | Self::Order(commands::arm::OrderError::Give(_)) => 3,
            _ => 1,
        }
    }
}

/// The failure's text, with its cause where that is a limit of this process: whatever could not be opened then is not
/// what is wrong.
pub(super) fn with_cause(text: String) -> String {
    // EMFILE and ENFILE, as the standard library words them.
    if text.contains("(os error 24)") {
        let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
        let limit = limit.map_or_else(String::new, |limit| format!(" of {limit} open files"));
        return format!("the limit{limit} is reached; raise it (`ulimit -n 4096`, or LimitNOFILE= in the unit)");
    }
    if text.contains("(os error 23)") {
        return "this machine has too many files open (sysctl fs.file-max): end what opens them, or raise the limit"
            .to_owned();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::folder::FolderError;

    #[test]
    fn a_limit_that_is_reached_is_named_and_not_the_file_that_was_opened_then() {
        let of = |code| {
            let error = io::Error::from_raw_os_error(code);
            let folder = FolderError::Io { path: PathBuf::from("out"), error };
            with_cause(Failure::Folder(RecordError::Folder(folder)).to_string())
        };
        let said = of(24);
        assert!(said.contains("open files is reached") && said.contains("ulimit -n"), "{said}");
        assert!(said.contains("LimitNOFILE=") && !said.contains("--out"), "{said}");
        assert!(of(23).contains("fs.file-max"), "{}", of(23));
        assert!(of(13).contains("--out") && of(13).contains("Permission denied"), "{}", of(13));
    }
}
