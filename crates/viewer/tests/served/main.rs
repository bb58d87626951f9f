//! The server as its clients see it, good and bad ones.

mod client;
mod editing;
mod live;
mod security;
