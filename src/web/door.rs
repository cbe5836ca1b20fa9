//! Who is let in: what a request must have, beside its path, to be answered.
//!
//! A browser on this machine, or in this network, sends requests of whatever page is open in it:
//!
//! - a page of another host, whose name resolves to this machine ("DNS rebinding"): its requests name that host in `Host`.
//!   Only addresses, `localhost` and, where a token is needed, the machine's own name are accepted;
//! - a page of another site: it may send a POST, but its `Origin` is another. It may embed a GET; then `Sec-Fetch-Site`
//!   (<https://www.w3.org/TR/fetch-metadata/>) names it as foreign.
//!
//! Invariant: nothing but the page itself, which holds no secret, is sent to a client that has not shown the token, if one is
//! needed.

use hyper::header::{COOKIE, HOST, HeaderMap, HeaderName, ORIGIN};
use hyper::{Method, StatusCode};
use rapid_core::site;

use super::token::Source;

/// Why a request is not answered: the status, and why in words.
pub(super) type Refusal = (StatusCode, &'static str);

#[derive(Debug)]
pub(super) struct Door {
    /// `None`: none is needed.
    pub(super) token: Option<Source>,
    /// The name of this machine.
    pub(super) machine: String,
    /// Ports of a host share its cookies: the port is part of the name.
    pub(super) port: u16,
}

/// How much of this rig a request gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Asked {
    /// The page, without any content.
    Page,
    /// To show the token.
    Entry,
    /// Everything else.
    Rig,
}

impl Door {
    /// Whether the request may be answered.
    ///
    /// # Errors
    /// When it may not: why.
    pub(super) fn admit(&self, asked: Asked, method: &Method, headers: &HeaderMap) -> Result<(), Refusal> {
        let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
        let host = text(HOST).filter(|host| self.is_own(host)).ok_or((
            StatusCode::MISDIRECTED_REQUEST,
            "open this page by the address of the machine, as its link does, and not by another name",
        ))?;
        if asked != Asked::Page {
            let site = text(HeaderName::from_static("sec-fetch-site"));
            if site.is_some_and(|site| !matches!(site, "same-origin" | "none")) {
                return Err(FOREIGN);
            }
        }
        if method == Method::POST && text(ORIGIN).is_none_or(|origin| !site::is_page_of(origin, host)) {
            return Err(FOREIGN);
        }
        if asked == Asked::Rig && !self.has_token(headers) {
            return Err(NO_TOKEN);
        }
        Ok(())
    }

    /// Whether the client has shown the token, or needs none.
    pub(super) fn has_token(&self, headers: &HeaderMap) -> bool {
        let Some(source) = &self.token else { return true };
        let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
        let pairs = cookies.flat_map(|cookies| cookies.split("; ")).filter_map(|cookie| cookie.split_once('='));
        let own = self.cookie_name();
        let mut shown = pairs.filter(|(name, _)| *name == own).peekable();
        // The file is not read for those who show nothing.
        let token = shown.peek().and_then(|_| source.token());
        token.is_some_and(|token| shown.any(|(_, value)| token.is(value)))
    }

    /// The cookie of a client that has shown this token; `None` if it is the wrong one.
    pub(super) fn cookie(&self, shown: &str) -> Option<String> {
        let token = self.token.as_ref()?.token().filter(|token| token.is(shown))?;
        // A month: with a token that is kept in a file, phones come back.
        Some(format!("{}={}; Max-Age=2592000; Path=/; HttpOnly; SameSite=Strict", self.cookie_name(), token.text()))
    }

    fn cookie_name(&self) -> String {
        format!("rapid-{}", self.port)
    }

    /// Whether `Host` names this machine. Others may answer for its name; they do not have its token.
    fn is_own(&self, host: &str) -> bool {
        site::is_own(host, self.token.is_some().then_some(&self.machine))
    }
}

const FOREIGN: Refusal = (StatusCode::FORBIDDEN, "this was requested by a page of another site");

/// The answer to a client that has not shown the token.
pub(super) const NO_TOKEN: Refusal = (
    StatusCode::UNAUTHORIZED,
    "this needs the link with the token: in the monitor, W shows it as a QR code; a run without a monitor prints it",
);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::token::Token;

    fn headers(of: &[(&'static str, &str)]) -> HeaderMap {
        of.iter().map(|(name, value)| (HeaderName::from_static(name), value.parse().unwrap())).collect()
    }

    fn door(token: Option<&Token>) -> Door {
        Door { token: token.cloned().map(Source::Run), machine: "rig7".to_owned(), port: 8766 }
    }

    #[test]
    fn only_names_of_this_machine_are_answered() {
        let token = Token::random().unwrap();
        let admits = |token, host: &[(&'static str, &str)]| {
            door(token).admit(Asked::Page, &Method::GET, &headers(host)).map_err(|(status, _)| status.as_u16())
        };
        for host in ["127.0.0.1:8766", "localhost:9000", "LOCALHOST", "[::1]:8766", "192.168.1.7:8766", "10.0.0.1"] {
            assert_eq!(admits(None, &[("host", host)]), Ok(()), "{host}");
        }
        for host in
            ["evil.example", "evil.example:8766", "127.0.0.1.evil.example", "", "rig7:8766", "rig7.local", ":8766"]
        {
            assert_eq!(admits(None, &[("host", host)]), Err(421), "{host}");
        }
        assert_eq!(admits(None, &[]), Err(421));
        for host in ["rig7:8766", "rig7.local:8766", "Rig7.local"] {
            assert_eq!(admits(Some(&token), &[("host", host)]), Ok(()), "{host}");
        }
        assert_eq!(admits(Some(&token), &[("host", "rig8.local")]), Err(421));
    }

    #[test]
    fn a_page_of_another_site_is_refused() {
        let asks = |asked, method: Method, of: &[(&'static str, &str)]| {
            let own = [&[("host", "127.0.0.1:8766")], of].concat();
            door(None).admit(asked, &method, &headers(&own)).map_err(|(status, _)| status.as_u16())
        };
        assert_eq!(asks(Asked::Rig, Method::POST, &[("origin", "http://127.0.0.1:8766")]), Ok(()));
        assert_eq!(asks(Asked::Rig, Method::POST, &[("origin", "https://127.0.0.1:8766")]), Ok(()));
        for origin in ["http://evil.example", "http://127.0.0.1:8765", "http://localhost:8766", "null", ""] {
            assert_eq!(asks(Asked::Rig, Method::POST, &[("origin", origin)]), Err(403), "{origin}");
            assert_eq!(asks(Asked::Entry, Method::POST, &[("origin", origin)]), Err(403), "{origin}");
        }
        assert_eq!(asks(Asked::Rig, Method::POST, &[]), Err(403));
        for (site, expected) in
            [("same-origin", Ok(())), ("none", Ok(())), ("cross-site", Err(403)), ("same-site", Err(403))]
        {
            assert_eq!(asks(Asked::Rig, Method::GET, &[("sec-fetch-site", site)]), expected, "{site}");
        }
        // A link on another page may lead here.
        assert_eq!(asks(Asked::Page, Method::GET, &[("sec-fetch-site", "cross-site")]), Ok(()));
    }

    #[test]
    fn the_rig_is_for_those_who_have_shown_the_token() {
        let (token, other) = (Token::random().unwrap(), Token::random().unwrap());
        let door = door(Some(&token));
        let asks = |asked, cookie: &str| {
            let headers = headers(&[("host", "192.168.1.7:8766"), ("cookie", cookie)]);
            door.admit(asked, &Method::GET, &headers).map_err(|(status, _)| status.as_u16())
        };
        let cookie = door.cookie(token.text()).unwrap();
        let (pair, rest) = cookie.split_once(';').unwrap();
        assert!(rest.contains("HttpOnly") && rest.contains("SameSite=Strict"), "{rest}");
        assert_eq!(asks(Asked::Rig, pair), Ok(()));
        assert_eq!(asks(Asked::Rig, &format!("a=b; {pair}")), Ok(()));
        let wrong = [
            String::new(),
            "rapid-8766=".to_owned(),
            format!("rapid-8766={}", other.text()),
            format!("rapid-1={}", token.text()),
        ];
        for cookie in &wrong {
            assert_eq!(asks(Asked::Rig, cookie), Err(401), "{cookie}");
            assert_eq!(asks(Asked::Page, cookie), Ok(()));
            assert_eq!(asks(Asked::Entry, cookie), Ok(()));
        }
        assert_eq!(door.cookie(other.text()), None);
        assert_eq!(door.cookie(""), None);
    }
}
