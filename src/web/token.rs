//! The token that the page needs: who has it may see what the sensors see, and begin and end episodes.
//!
//! Invariant: it has at least 128 random bits, or is as long as such a one; how long a comparison takes does not depend on
//! where two differ.
//! Invariant: of a file, what it has now is in force and nothing else: who removes or replaces it locks everybody out at once.

use std::cell::RefCell;
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

    /// The one in this file. Blocks.
    ///
    /// # Errors
    /// When there is no file, others may read it, or it holds no token.
    fn read(path: &Path) -> Result<Self, TokenError> {
        let of_file = |error| TokenError::File { path: path.to_owned(), error };
        let file = fs::File::open(path).map_err(of_file)?;
        let about = file.metadata().map_err(of_file)?;
        if about.is_file() && about.mode() & 0o077 != 0 {
            return Err(TokenError::Readable { path: path.to_owned() });
        }
        let mut text = String::new();
        file.take(LONGEST as u64 + 2).read_to_string(&mut text).map_err(of_file)?;
        Self::parse(text.trim_end()).ok_or_else(|| TokenError::Content { path: path.to_owned() })
    }

    /// The one in this file; if there is no file, a new one is written to it. Blocks.
    ///
    /// # Errors
    /// When others may read the file, or it holds no token.
    fn kept(path: &Path) -> Result<Self, TokenError> {
        let of_file = |error| TokenError::File { path: path.to_owned(), error };
        match Self::read(path) {
            Err(TokenError::File { error, .. }) if error.kind() == io::ErrorKind::NotFound => {
                let token = Self::random()?;
                let mut file =
                    OpenOptions::new().write(true).create_new(true).mode(0o600).open(path).map_err(of_file)?;
                file.write_all(format!("{}\n", token.0).as_bytes()).map_err(of_file)?;
                Ok(token)
            }
            read => read,
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

/// Where the token in force is.
#[derive(Debug)]
pub(super) enum Source {
    /// With the run.
    Run(Token),
    /// In this file, and the one that was there at the last [`Source::look`].
    File(PathBuf, RefCell<Option<Token>>),
}

impl Source {
    /// A new token, for this run.
    ///
    /// # Errors
    /// When the system has no random numbers.
    pub(super) fn of_run() -> Result<Self, TokenError> {
        Ok(Self::Run(Token::random()?))
    }

    /// The token of this file, which is written if there is none. Blocks.
    ///
    /// # Errors
    /// When others may read the file, or it holds no token.
    pub(super) fn of_file(path: &Path) -> Result<Self, TokenError> {
        let token = Token::kept(path)?;
        // A pipe gives it once.
        let is_file = fs::metadata(path).is_ok_and(|about| about.is_file());
        Ok(if is_file { Self::File(path.to_owned(), RefCell::new(Some(token))) } else { Self::Run(token) })
    }

    /// The token in force. `None`: its file has none, and nobody is let in.
    pub(super) fn token(&self) -> Option<Token> {
        match self {
            Self::Run(token) => Some(token.clone()),
            Self::File(path, _) => Token::read(path).ok(),
        }
    }

    /// Replaces the token if its file was removed. `None` if the one in force is that of the last look, or there is none still.
    ///
    /// # Errors
    /// When there is none any more: why.
    pub(super) fn look(&self) -> Option<Result<Token, TokenError>> {
        let Self::File(path, last) = self else { return None };
        let kept = Token::kept(path);
        let last = last.replace(kept.as_ref().ok().cloned());
        match &kept {
            Ok(token) => last.as_ref() != Some(token),
            Err(_) => last.is_some(),
        }
        .then_some(kept)
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

    #[test]
    fn what_the_file_has_now_is_in_force() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        let source = Source::of_file(&path).unwrap();
        let first = source.token().unwrap();
        assert!(source.look().is_none());
        fs::remove_file(&path).unwrap();
        assert_eq!(source.token(), None);
        let second = source.look().unwrap().unwrap();
        assert!(second != first && source.token() == Some(second) && source.look().is_none());
        // Another one is in force before anybody looks.
        fs::write(&path, format!("{}\n", first.text())).unwrap();
        assert_eq!(source.token(), Some(first.clone()));
        assert_eq!(source.look().unwrap().unwrap(), first);
        // What would be refused at the start is no token, and reported once.
        for spoil in [&|| fs::write(&path, "short"), &|| fs::remove_dir_all(folder.path())] as [&dyn Fn() -> _; 2] {
            fs::write(&path, format!("{}\n", first.text())).unwrap();
            let _ = source.look();
            spoil().unwrap();
            assert_eq!(source.token(), None);
            assert!(source.look().unwrap().is_err() && source.look().is_none());
        }
    }
}
