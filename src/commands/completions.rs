//! `rapid completions`, `rapid man` and `rapid keys`: completion scripts and manual pages of the commands; the keys of the
//! registry.

use std::io::{self, Write};
use std::path::Path;

use rapid_registry::keys;

use super::artifacts::{ArtifactsError, links_for_this_user, write_file};

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

/// Writes the reference of the registry's keys, or their JSON schema.
///
/// # Errors
/// When `out` cannot be written.
pub fn keys(schema: bool, out: &mut impl Write) -> io::Result<()> {
    let text = if schema { keys::schema_text() } else { keys::reference() };
    out.write_all(text.as_bytes())
}

/// Writes a manual page for `command` and each of its subcommands into `folder`, and lists them.
///
/// # Errors
/// When a page cannot be written.
pub fn man(command: clap::Command, folder: &Path, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    let mut command = command.disable_help_subcommand(true);
    command.build();
    let mut left = vec![command];
    while let Some(command) = left.pop() {
        left.extend(command.get_subcommands().cloned());
        let page = clap_mangen::Man::new(command);
        let mut text = Vec::new();
        page.render(&mut text)?;
        let path = folder.join(page.get_filename());
        write_file(&path, &text, 0o644, links_for_this_user())?;
        writeln!(out, "wrote {}", path.display())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::Cli;

    #[test]
    fn each_shell_gets_a_script_with_the_subcommands() {
        for shell in [clap_complete::Shell::Bash, clap_complete::Shell::Zsh, clap_complete::Shell::Fish] {
            let mut script = Vec::new();
            completions(&mut Cli::grammar(), shell, &mut script).unwrap();
            let script = String::from_utf8(script).unwrap();
            assert!(script.contains("rapid") && script.contains("inspect"), "{shell}");
        }
    }

    #[test]
    fn each_command_has_a_manual_page_with_its_own_options_and_examples() {
        fn pages(prefix: &str, command: &clap::Command) -> Vec<String> {
            let of = |command: &clap::Command| pages(&format!("{prefix}-{}", command.get_name()), command);
            command.get_subcommands().flat_map(of).chain([format!("{prefix}.1")]).collect()
        }
        let folder = tempfile::tempdir().unwrap();
        man(Cli::grammar(), folder.path(), &mut Vec::new()).unwrap();
        let mut expected = pages("rapid", &Cli::grammar());
        let read = std::fs::read_dir(folder.path()).unwrap();
        let mut written: Vec<_> = read.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        expected.sort();
        written.sort();
        assert_eq!(written, expected);
        assert!(expected.contains(&"rapid-calibrate-latency.1".to_owned()));
        for page in &written {
            let text = std::fs::read_to_string(folder.path().join(page)).unwrap();
            assert!(text.contains("Examples:"), "{page} has no examples");
        }
        let mask = std::fs::read_to_string(folder.path().join("rapid-mask.1")).unwrap();
        assert!(mask.contains("watch") && mask.contains("instance") && !mask.contains("config"), "{mask}");
    }
}
