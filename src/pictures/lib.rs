//! Pictures as bytes and as pixels: JPEG, the formats of cameras, depth as shades, and QR codes.
//!
//! A crate of its own, because the JPEG libraries are generic: their code is compiled with the crate that calls it. This one is
//! optimised in tests, too, which decode and encode tens of thousands of pictures; so what goes through every pixel is here.

#![forbid(unsafe_code)]

pub mod jpeg;
pub mod judge;
pub mod pixels;
pub mod qr;
