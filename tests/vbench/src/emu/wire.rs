//! USB/IP on the wire: 48-byte headers, big endian, as in the kernel's `Documentation/usb/usbip_protocol.rst`.
//!
//! Invariant: pure; bytes in, values out. Isochronous transfers are not supported.

use thiserror::Error;

/// Every message starts with a header of this size.
pub const HEADER_LEN: usize = 48;

/// Largest data stage accepted from the host; the kernel's own transfers stay far below.
pub const MAX_TRANSFER: u32 = 1 << 20;

const CMD_SUBMIT: u32 = 1;
const CMD_UNLINK: u32 = 2;
const RET_SUBMIT: u32 = 3;
const RET_UNLINK: u32 = 4;

/// Status of a transfer as the host controller reports it: 0 or a negated errno.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
pub enum Status {
    /// Completed.
    Ok = 0,
    /// STALL handshake (-EPIPE).
    Stall = -32,
    /// Cancelled by an unlink (-ECONNRESET).
    Unlinked = -104,
}

/// A request of the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// A transfer.
    Submit(Submit),
    /// Cancel the transfer with sequence number `victim`.
    Unlink {
        /// Sequence number of this request.
        seq: u32,
        /// Sequence number of the transfer to cancel.
        victim: u32,
    },
}

/// One transfer (URB). Data to the device follows the header on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Submit {
    /// Sequence number the reply repeats.
    pub seq: u32,
    /// Device to host.
    pub is_in: bool,
    /// Endpoint number without its direction bit.
    pub endpoint: u8,
    /// Size of the host's buffer, or of the data that follows.
    pub length: u32,
    /// Setup packet; meaningful on endpoint 0.
    pub setup: [u8; 8],
}

/// A header that is not supported; the connection cannot continue.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum WireError {
    /// A command other than submit and unlink.
    #[error("unknown usb/ip command {0:#x}")]
    UnknownCommand(u32),
    /// A transfer beyond `MAX_TRANSFER`.
    #[error("transfer of {0} bytes exceeds {MAX_TRANSFER}")]
    Oversized(u32),
    /// An endpoint number USB does not have.
    #[error("endpoint {0} does not exist")]
    Endpoint(u32),
}

/// Decodes a request header.
pub fn decode(header: &[u8; HEADER_LEN]) -> Result<Request, WireError> {
    let word = |index: usize| {
        let at = index * 4;
        u32::from_be_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]])
    };
    let seq = word(1);
    match word(0) {
        CMD_SUBMIT => {
            let endpoint = word(4);
            let length = word(6);
            if length > MAX_TRANSFER {
                return Err(WireError::Oversized(length));
            }
            let mut setup = [0; 8];
            setup.copy_from_slice(&header[40..48]);
            Ok(Request::Submit(Submit {
                seq,
                is_in: word(3) == 1,
                endpoint: u8::try_from(endpoint).ok().filter(|e| *e < 16).ok_or(WireError::Endpoint(endpoint))?,
                length,
                setup,
            }))
        }
        CMD_UNLINK => Ok(Request::Unlink { seq, victim: word(5) }),
        other => Err(WireError::UnknownCommand(other)),
    }
}

/// The header of a transfer's completion; `actual` bytes were transferred. Data to the host follows it.
pub fn submit_reply(seq: u32, status: Status, actual: usize) -> [u8; HEADER_LEN] {
    let actual = u32::try_from(actual).expect("transfers are bounded by MAX_TRANSFER");
    reply(RET_SUBMIT, seq, status, actual)
}

/// The answer to an unlink: `Unlinked` when the transfer was still pending, `Ok` when it had completed before.
pub fn unlink_reply(seq: u32, status: Status) -> [u8; HEADER_LEN] {
    reply(RET_UNLINK, seq, status, 0)
}

fn reply(command: u32, seq: u32, status: Status, actual: u32) -> [u8; HEADER_LEN] {
    let mut header = [0; HEADER_LEN];
    header[0..4].copy_from_slice(&command.to_be_bytes());
    header[4..8].copy_from_slice(&seq.to_be_bytes());
    header[20..24].copy_from_slice(&(status as i32).to_be_bytes());
    header[24..28].copy_from_slice(&actual.to_be_bytes());
    header
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(words: [u32; 10], setup: [u8; 8]) -> [u8; HEADER_LEN] {
        let mut bytes = [0; HEADER_LEN];
        for (index, word) in words.iter().enumerate() {
            bytes[index * 4..index * 4 + 4].copy_from_slice(&word.to_be_bytes());
        }
        bytes[40..].copy_from_slice(&setup);
        bytes
    }

    #[test]
    fn decodes_a_control_transfer() {
        let setup = [0x80, 6, 0, 1, 0, 0, 18, 0];
        let bytes = header([CMD_SUBMIT, 7, 0x1_0002, 1, 0, 0, 18, 0, u32::MAX, 0], setup);
        let expected = Submit { seq: 7, is_in: true, endpoint: 0, length: 18, setup };
        assert_eq!(decode(&bytes), Ok(Request::Submit(expected)));
    }

    #[test]
    fn decodes_an_unlink() {
        let bytes = header([CMD_UNLINK, 9, 0, 0, 0, 7, 0, 0, 0, 0], [0; 8]);
        assert_eq!(decode(&bytes), Ok(Request::Unlink { seq: 9, victim: 7 }));
    }

    #[test]
    fn rejects_unsupported_requests() {
        let unknown = header([5, 0, 0, 0, 0, 0, 0, 0, 0, 0], [0; 8]);
        assert_eq!(decode(&unknown), Err(WireError::UnknownCommand(5)));
        let large = header([CMD_SUBMIT, 0, 0, 0, 2, 0, MAX_TRANSFER + 1, 0, 0, 0], [0; 8]);
        assert_eq!(decode(&large), Err(WireError::Oversized(MAX_TRANSFER + 1)));
        let nowhere = header([CMD_SUBMIT, 0, 0, 0, 16, 0, 0, 0, 0, 0], [0; 8]);
        assert_eq!(decode(&nowhere), Err(WireError::Endpoint(16)));
    }

    #[test]
    fn replies_carry_sequence_status_and_length() {
        let ok = submit_reply(7, Status::Ok, 18);
        assert_eq!(ok[0..8], [0, 0, 0, 3, 0, 0, 0, 7]);
        assert_eq!(ok[20..28], [0, 0, 0, 0, 0, 0, 0, 18]);
        let gone = unlink_reply(9, Status::Unlinked);
        assert_eq!(gone[0..8], [0, 0, 0, 4, 0, 0, 0, 9]);
        assert_eq!(i32::from_be_bytes([gone[20], gone[21], gone[22], gone[23]]), -104);
    }
}
