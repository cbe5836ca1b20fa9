//! Chooses and loads the onnxruntime library.
//!
//! The program carries the library, packed by `build.rs`. It is unpacked into memory that has no
//! name in any file system (`memfd_create`) and loaded from there, so that nothing is installed and
//! nothing is left behind. Another library is used if it is named by `--ort-lib` or, as in other
//! programs with onnxruntime, by `ORT_DYLIB_PATH`.
//!
//! The C++ library that it needs comes first, see `loader`.
//!
//! Invariant: nothing is unpacked, loaded or started before [`Environment::open`] is called.
//! Invariant: a named library is used or the error gives the reason; no other one is used
//! instead.

mod loader;

use std::ffi::CString;
use std::io;
use std::os::fd::AsRawFd as _;
use std::os::unix::ffi::OsStrExt as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ort::logging::LogLevel;
/// The version of the program, and a line for each library that is built in.
pub const LONG_VERSION: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    "\nonnxruntime: ",
    env!("RAPID_BUILT_WITH"),
    "\nlibstdc++: ",
    env!("RAPID_BUILT_WITH_CXX")
);

/// The packed library; empty in a build without one.
static INSIDE: &[u8] = include_bytes!(env!("RAPID_ONNXRUNTIME"));
/// The variable that names another library.
const VARIABLE: &str = "ORT_DYLIB_PATH";
/// The oldest usable onnxruntime: feature `api-24` of the crate `ort`.
const OLDEST: u32 = ort::MINOR_VERSION;

/// The library loaded in this process. Only one environment may be created per process.
static LOADED: Mutex<Option<Environment>> = Mutex::new(None);

/// The loaded library, ready for graphs. Clones share it.
#[derive(Debug, Clone)]
pub struct Environment {
    /// Used by graphs.
    pub(super) ort: ort::environment::Environment,
    /// Where the library comes from.
    pub origin: Origin,
}

/// Where a library comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// `--ort-lib`.
    Option(PathBuf),
    /// `ORT_DYLIB_PATH`.
    Variable(PathBuf),
    /// This program.
    Inside,
}

impl std::fmt::Display for Origin {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Option(path) => write!(f, "{} (--ort-lib)", path.display()),
            Self::Variable(path) => write!(f, "{} ({VARIABLE})", path.display()),
            Self::Inside => f.write_str(if INSIDE.is_empty() { "built in" } else { env!("RAPID_BUILT_WITH") }),
        }
    }
}

/// Why onnxruntime is unavailable.
#[derive(Debug, thiserror::Error)]
#[error("onnxruntime: {origin}: {cause}; {}", cause.fix(origin))]
pub struct LibraryError {
    /// What was tried.
    pub origin: Origin,
    /// Why that failed.
    pub cause: Cause,
}

/// Why a library cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Cause {
    /// This program was built without one.
    #[error("this rapid was built without one")]
    LeftOut,
    /// There is no such file.
    #[error("there is no such file")]
    Missing,
    /// A library that it needs is not on this machine.
    #[error("it needs {library}, which this machine does not have{}", install(*package))]
    Needs {
        /// The name of a library.
        library: String,
        /// Debian's package with it, if known.
        package: Option<&'static str>,
    },
    /// It cannot be loaded, in the loader's words.
    #[error("it cannot be loaded: {0}")]
    Unloadable(String),
    /// It is too old for this program.
    #[error("it is version {0}, and 1.{OLDEST} is the oldest that works")]
    TooOld(String),
    /// No memory may be mapped as executable.
    #[error("it cannot be unpacked into memory: {0}")]
    Memory(#[source] io::Error),
    /// It was loaded but does not start.
    #[error("it does not start: {0}")]
    Unusable(String),
}

impl Cause {
    fn fix(&self, origin: &Origin) -> String {
        let name_one = format!(
            "name a libonnxruntime.so of version 1.{OLDEST} or later with --ort-lib PATH or {VARIABLE} (the Python package \
             `onnxruntime` holds one, in its folder `capi`)"
        );
        match (self, origin) {
            (Self::LeftOut, _) => format!("run `make setup` and build again, or {name_one}"),
            (_, Origin::Option(_)) if !INSIDE.is_empty() => {
                format!("{name_one}, or leave --ort-lib out: rapid carries one")
            }
            (_, Origin::Variable(_)) if !INSIDE.is_empty() => format!("{name_one}, or unset it: rapid carries one"),
            _ => name_one,
        }
    }
}

impl Environment {
    /// Loads onnxruntime: the file `named` by `--ort-lib`, else the one that `ORT_DYLIB_PATH` names,
    /// else the embedded one. A process loads it once: later calls return the first one.
    ///
    /// # Errors
    /// When that library cannot be used. The message gives the attempts and the fix.
    pub fn open(named: Option<&Path>) -> Result<Self, LibraryError> {
        let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(environment) = &*loaded {
            return Ok(environment.clone());
        }
        let origin = choose(named, std::env::var_os(VARIABLE).map(PathBuf::from));
        let environment = match load(&origin) {
            Ok(ort) => Self { ort, origin },
            Err(cause) => return Err(LibraryError { origin, cause }),
        };
        tracing::debug!(origin = %environment.origin, "onnxruntime loaded");
        Ok(loaded.insert(environment).clone())
    }
}

/// Which library to use. An empty variable counts as unset.
fn choose(named: Option<&Path>, variable: Option<PathBuf>) -> Origin {
    match (named, variable.filter(|path| !path.as_os_str().is_empty())) {
        (Some(path), _) => Origin::Option(path.to_owned()),
        (None, Some(path)) => Origin::Variable(path),
        (None, None) => Origin::Inside,
    }
}

fn install(package: Option<&str>) -> String {
    package.map_or_else(String::new, |package| format!(": apt install {package} on Debian and Ubuntu"))
}

fn load(origin: &Origin) -> Result<ort::environment::Environment, Cause> {
    match origin {
        Origin::Option(path) | Origin::Variable(path) => {
            if !path.exists() {
                return Err(Cause::Missing);
            }
            // A library from another vendor may need none.
            let _ = loader::load_libstdcxx();
            // `ort` looks for a relative path beside the program first.
            start(&std::path::absolute(path).unwrap_or_else(|_| path.clone()))
        }
        Origin::Inside if INSIDE.is_empty() => Err(Cause::LeftOut),
        Origin::Inside => {
            loader::load_libstdcxx()?;
            let memory = loader::unpack(c"libonnxruntime.so", INSIDE).map_err(Cause::Memory)?;
            // The loader maps the memory; the descriptor is not needed any longer.
            start(Path::new(&format!("/proc/self/fd/{}", memory.as_raw_fd())))
        }
    }
}

fn start(path: &Path) -> Result<ort::environment::Environment, Cause> {
    // Checked here because the error of `ort` does not name what is missing.
    let name = CString::new(path.as_os_str().as_bytes()).map_err(|_| Cause::Missing)?;
    loader::load_onnxruntime(&name)?;
    let builder = ort::init_from(path).map_err(|error| match error {
        ort::LoadDynamicError::BadVersion { version_str, .. } => Cause::TooOld(version_str),
        ort::LoadDynamicError::Dlopen { error, .. } => Cause::Unloadable(error.to_string()),
        ort::LoadDynamicError::MissingApi { .. } | ort::LoadDynamicError::InvalidVersionString => {
            Cause::Unloadable("it is not onnxruntime".to_owned())
        }
    })?;
    let environment = builder
        .with_name("rapid")
        .with_telemetry(false)
        .with_logger(Arc::new(log))
        .build()
        .map_err(|error| Cause::Unusable(error.to_string()))?;
    // Messages of lower levels would be formatted at every run only to be discarded.
    environment.set_log_level(LogLevel::Warning);
    Ok(environment)
}

fn log(level: LogLevel, _category: &str, graph: &str, _location: &str, message: &str) {
    match level {
        LogLevel::Fatal | LogLevel::Error => tracing::error!(graph, "onnxruntime: {message}"),
        LogLevel::Warning => tracing::warn!(graph, "onnxruntime: {message}"),
        LogLevel::Info | LogLevel::Verbose => tracing::debug!(graph, "onnxruntime: {message}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_option_precedes_the_variable_which_precedes_the_embedded_library() {
        let variable = || Some(PathBuf::from("/v/libonnxruntime.so"));
        let named = Path::new("/n/libonnxruntime.so");
        assert_eq!(choose(Some(named), variable()), Origin::Option(named.to_owned()));
        assert_eq!(choose(None, variable()), Origin::Variable(PathBuf::from("/v/libonnxruntime.so")));
        assert_eq!(choose(None, Some(PathBuf::new())), Origin::Inside);
        assert_eq!(choose(None, None), Origin::Inside);
    }

    #[test]
    fn a_missing_library_is_an_error_with_the_attempts_and_a_fix() {
        let missing = tempfile::tempdir().unwrap().path().join("missing.so");
        let origin = Origin::Option(missing.clone());
        let error = LibraryError { cause: load(&origin).unwrap_err(), origin }.to_string();
        let begin = format!("onnxruntime: {} (--ort-lib): there is no such file", missing.display());
        assert!(error.starts_with(&begin), "{error}");
        assert!(error.contains("name a libonnxruntime.so of version 1.24 or later"), "{error}");
    }

    #[test]
    fn every_cause_has_a_fix() {
        let causes = [Cause::LeftOut, Cause::Missing, Cause::TooOld("1.20.1".to_owned())];
        for cause in causes {
            let error = LibraryError { origin: Origin::Variable("/v.so".into()), cause }.to_string();
            assert!(error.contains("--ort-lib PATH or ORT_DYLIB_PATH"), "{error}");
        }
    }

    #[test]
    fn the_embedded_library_is_whole_and_loaded_once() {
        assert!(!INSIDE.is_empty(), "built without onnxruntime, which `make setup` fetches");
        let memory = loader::unpack(c"libonnxruntime.so", INSIDE).unwrap();
        assert!(memory.metadata().unwrap().len() > 10_000_000);
        drop(memory);
        let first = Environment::open(None).unwrap();
        let second = Environment::open(Some(Path::new("/no/such/file"))).unwrap();
        assert_eq!(first.origin, second.origin);
    }
}
