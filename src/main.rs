//! Entry point: the guard of a bus of motors if it was started as one; otherwise parses the command line, runs the
//! command and sets the exit code.

use std::process::ExitCode;

#[cfg(feature = "motors")]
use rapid_devices::driver::can::guard;

fn main() -> ExitCode {
    #[cfg(feature = "motors")]
    let mut args = std::env::args_os();
    #[cfg(feature = "motors")]
    if args.next().is_some_and(|name| name == guard::NAME) {
        return guard::run(args);
    }
    match rapid::cli::Cli::read(std::env::args_os()) {
        Ok(cli) => rapid::dispatch::dispatch(cli),
        Err(error) => rapid::dispatch::refuse(&error),
    }
}
