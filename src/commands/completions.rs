//! `rapid completions SHELL`: a completion script.

use std::io::{self, Write};

/// Writes the completion script of `command` for `shell`.
///
/// # Errors
/// When `out` cannot be written.
pub fn completions(command: &mut clap::Command, shell: clap_complete::Shell, out: &mut impl Write) -> io::Result<()> {
    let name = command.get_name().to_owned();
    let mut script = Vec::new();
    // The generator panics when its writer fails: it writes to memory, which does not.
    clap_complete::generate(shell, command, name, &mut script);
    out.write_all(&script)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_shell_gets_a_script_that_knows_the_subcommands() {
        for shell in [clap_complete::Shell::Bash, clap_complete::Shell::Zsh, clap_complete::Shell::Fish] {
            let mut command = clap::Command::new("rapid").subcommand(clap::Command::new("inspect"));
            let mut script = Vec::new();
            completions(&mut command, shell, &mut script).unwrap();
            let script = String::from_utf8(script).unwrap();
            assert!(script.contains("rapid") && script.contains("inspect"), "{shell}");
        }
    }
}
