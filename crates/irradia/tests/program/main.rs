//! The program `irradia` as users run it: a process with arguments, folders, an exit code and two streams.

mod bad_input;
mod compare;
mod edit;
mod field;
mod film;
mod lpips;
mod memory;
mod outputs;
mod pose;
mod process;
mod real_data;
mod recipe;
mod reproducible;
mod views;
