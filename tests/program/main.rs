// SPDX-License-Identifier: GPL-3.0-or-later
//! The program from outside, over a real pty, with our own client.

mod add;
mod bad_input;
mod camera;
mod commands;
mod configuration;
mod console;
mod dialects;
mod disk;
mod doctor;
mod guardian;
mod hostile;
mod kiauh;
mod life;
mod links;
mod one_order;
mod other_users;
mod own_printer;
mod preinst;
mod process;
mod recorder;
mod search;
mod sections;
mod show;
mod slow;
mod soak;
mod ssh;
mod status;
mod terminal;
mod toolpath;
mod trace;
mod troubleshooting;
mod uses;
