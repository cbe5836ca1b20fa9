//! Parses a GoPro's answers, and builds the request that sets its clock.
//!
//! Invariant: strings from the camera become part of a path only if they are plain names.

use rapid_core::time::Stamp;

/// The name of a clip on the card: plain names.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) struct Name {
    pub(super) folder: String,
    pub(super) file: String,
}

/// The camera's state report.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub(super) struct State {
    pub(super) recording: bool,
    busy: bool,
    battery_percent: Option<u64>,
    card_free_kb: Option<u64>,
    remaining_s: Option<u64>,
    #[serde(skip)]
    pub(super) asked: Stamp,
}

/// The request that sets the camera's clock to the local time, to the second.
pub(super) fn clock() -> String {
    // SAFETY: all zeroes are a valid value.
    let mut local: libc::tm = unsafe { std::mem::zeroed() };
    // SAFETY: a null pointer is allowed.
    let now = unsafe { libc::time(std::ptr::null_mut()) };
    // SAFETY: both pointers are to locals. Without time zones on the machine the result is UTC.
    unsafe { libc::localtime_r(&raw const now, &raw mut local) };
    format!(
        "/gopro/camera/set_date_time?date={:04}_{:02}_{:02}&time={:02}_{:02}_{:02}&tzone={}&dst={}",
        local.tm_year + 1900,
        local.tm_mon + 1,
        local.tm_mday,
        local.tm_hour,
        local.tm_min,
        local.tm_sec,
        // The zone without daylight saving, which is sent separately.
        local.tm_gmtoff / 60 - if local.tm_isdst > 0 { 60 } else { 0 },
        i32::from(local.tm_isdst > 0),
    )
}

/// The model and firmware, as `/gopro/camera/info` reports them.
pub(super) fn model(info: &[u8]) -> Option<String> {
    let info: serde_json::Value = serde_json::from_slice(info).ok()?;
    // Older firmware wraps the object.
    let info = info.get("info").unwrap_or(&info);
    let text = |key: &str| Some(info.get(key)?.as_str()?.chars().take(64).collect::<String>());
    let model = text("model_name")?;
    Some(text("firmware_version").map_or_else(|| model.clone(), |firmware| format!("{model}, firmware {firmware}")))
}

/// The serial number, as `/gopro/camera/info` reports it, if it is a plain name.
pub(super) fn serial(info: &[u8]) -> Option<String> {
    let info: serde_json::Value = serde_json::from_slice(info).ok()?;
    let info = info.get("info").unwrap_or(&info);
    Some(info.get("serial_number")?.as_str().filter(|serial| is_plain(serial))?.to_owned())
}

/// The state, whose fields are numbered (Open GoPro, "Camera State", status ids).
pub(super) fn state(answer: &[u8], asked: Stamp) -> Option<State> {
    const BUSY: &str = "8";
    const ENCODING: &str = "10";
    const REMAINING_VIDEO_S: &str = "35";
    const CARD_FREE_KB: &str = "54";
    const BATTERY_PERCENT: &str = "70";
    let answer: serde_json::Value = serde_json::from_slice(answer).ok()?;
    let status = answer.get("status")?.as_object()?;
    let number = |id: &str| status.get(id)?.as_u64();
    Some(State {
        recording: number(ENCODING)? != 0,
        busy: number(BUSY).is_some_and(|busy| busy != 0),
        battery_percent: number(BATTERY_PERCENT),
        card_free_kb: number(CARD_FREE_KB),
        remaining_s: number(REMAINING_VIDEO_S),
        asked,
    })
}

/// The newest clip, from the answer to `last_captured`; `None` if the card has none.
pub(super) fn newest(answer: &[u8]) -> Result<Option<Name>, String> {
    let answer: serde_json::Value = serde_json::from_slice(answer).map_err(|error| error.to_string())?;
    let answer = answer.as_object().ok_or("it is not an object")?;
    let word = |key: &str| answer.get(key).and_then(serde_json::Value::as_str).unwrap_or_default();
    let (folder, file) = (word("folder"), word("file"));
    if folder.is_empty() && file.is_empty() {
        return Ok(None);
    }
    let name = |key: &str, name: &str| {
        if is_plain(name) { Ok(name.to_owned()) } else { Err(format!("{key} {name:?} is not a plain name")) }
    };
    Ok(Some(Name { folder: name("folder", folder)?, file: name("file", file)? }))
}

/// The size that the camera reports of a clip, as text or number.
pub(super) fn size(info: &[u8]) -> Option<u64> {
    let info: serde_json::Value = serde_json::from_slice(info).ok()?;
    let size = info.get("s")?;
    size.as_u64().or_else(|| size.as_str()?.parse().ok())
}

/// Whether it may be part of a path.
pub(super) fn is_plain(name: &str) -> bool {
    let legal = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-' | b'.');
    (1..=64).contains(&name.len()) && !name.starts_with('.') && name.bytes().all(legal)
}
