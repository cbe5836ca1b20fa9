//! The token that the page needs: who has it may see what the sensors see, and begin and end episodes.
//!
//! Invariant: it has at least 128 random bits, or is as long as such a one; how long a comparison takes does not depend on
//! where two differ.

use std::fs::{self, OpenOptions};
use std::hint::black_box;
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use rustix::rand::{GetRandomFlags, getrandom};

/// Characters of a token, each of [`ALPHABET`]: 132 bits.
const LENGTH: usize = 22;
/// Longest token in a file.
const LONGEST: usize = 128;
/// The characters that a link and a cookie take as they are.
const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";

/// Why there is no token.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// The system has no random numbers.
    #[error("the system gives no random numbers: {0}")]
    Random(#[source] io::Error),
    /// The file cannot be read or written.
    #[error("--web-token {}: {error}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        error: io::Error,
    },
    /// Others may read the file.
    #[error("--web-token {}: other users may read it; `chmod 600 {}`, and delete it if one may have", path.display(), path.display())]
    Readable {
        /// The file.
        path: PathBuf,
    },
    /// The file has something else.
    #[error(
        "--web-token {}: needs {LENGTH} to {LONGEST} letters, digits, - or _ on one line; delete it, and rapid writes one",
        path.display()
    )]
    Content {
        /// The file.
        path: PathBuf,
    },
}

/// A token. Its `Debug` does not contain it.
#[derive(Clone, PartialEq, Eq)]
pub(super) struct Token(String);

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token")
    }
}

impl Token {
    /// A new one.
    ///
    /// # Errors
    /// When the system has no random numbers.
    pub(super) fn random() -> Result<Self, TokenError> {
        let mut bytes = [0; LENGTH];
        // Up to 256 bytes come whole.
        getrandom(&mut bytes, GetRandomFlags::empty()).map_err(|error| TokenError::Random(error.into()))?;
        let letter = |byte: u8| ALPHABET.get(usize::from(byte & 63)).copied().map_or('A', char::from);
        Ok(Self(bytes.into_iter().map(letter).collect()))
    }

    /// The one in this file; if there is no file, a new one is written to it. Blocks.
    ///
    /// # Errors
    /// When others may read the file, or it holds no token.
    pub(super) fn kept(path: &Path) -> Result<Self, TokenError> {
        let of_file = |error| TokenError::File { path: path.to_owned(), error };
        match fs::File::open(path) {
            Ok(file) => {
                let about = file.metadata().map_err(of_file)?;
                if about.is_file() && about.mode() & 0o077 != 0 {
                    return Err(TokenError::Readable { path: path.to_owned() });
                }
                let mut text = String::new();
                file.take(LONGEST as u64 + 2).read_to_string(&mut text).map_err(of_file)?;
                Self::parse(text.trim_end()).ok_or_else(|| TokenError::Content { path: path.to_owned() })
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let token = Self::random()?;
                let mut file =
                    OpenOptions::new().write(true).create_new(true).mode(0o600).open(path).map_err(of_file)?;
                file.write_all(format!("{}\n", token.0).as_bytes()).map_err(of_file)?;
                Ok(token)
            }
            Err(error) => Err(of_file(error)),
        }
    }

    fn parse(text: &str) -> Option<Self> {
        let is_token = (LENGTH..=LONGEST).contains(&text.len()) && text.bytes().all(|byte| ALPHABET.contains(&byte));
        is_token.then(|| Self(text.to_owned()))
    }

    /// Whether it is this one.
    pub(super) fn is(&self, given: &str) -> bool {
        let pairs = self.0.bytes().zip(given.bytes());
        let differs = pairs.fold(0, |differs, (a, b)| black_box(differs | (a ^ b)));
        given.len() == self.0.len() && differs == 0
    }

    /// For a link, and for a cookie.
    pub(super) fn text(&self) -> &str {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_itself_and_nothing_else() {
        let (token, other) = (Token::random().unwrap(), Token::random().unwrap());
        assert!(token.is(token.text()) && !token.is(other.text()));
        assert!(!token.is("") && !token.is(&token.text()[1..]) && !token.is(&format!("{}A", token.text())));
        assert_eq!(token.text().len(), LENGTH);
        assert_eq!(format!("{token:?}"), "Token");
        assert_eq!(Token::parse(token.text()), Some(token));
        for text in ["", "short", "a b c d e f g h i j k l m n", &"a".repeat(LONGEST + 1), "aaaaaaaaaaaaaaaaaaaaaaaa;"]
        {
            assert_eq!(Token::parse(text), None, "{text}");
        }
    }

    #[test]
    fn a_token_is_kept_in_a_file_of_its_owner() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        let first = Token::kept(&path).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
        assert_eq!(Token::kept(&path).unwrap(), first);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
        assert!(matches!(Token::kept(&path), Err(TokenError::Readable { .. })));
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        for content in ["", "short\n", "two lines of text\nare none, however long\n"] {
            fs::write(&path, content).unwrap();
            assert!(matches!(Token::kept(&path), Err(TokenError::Content { .. })), "{content}");
        }
        assert!(matches!(Token::kept(&folder.path().join("none/token")), Err(TokenError::File { .. })));
        assert!(matches!(Token::kept(folder.path()), Err(TokenError::File { .. })));
    }
}
