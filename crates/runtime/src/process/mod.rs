// SPDX-License-Identifier: GPL-3.0-or-later
//! Pinion as a process of the kernel and of the service manager: real time, signals, the processes that it forks,
//! watchdogs.

pub(crate) mod forked;
pub mod helpers;
pub(crate) mod notify;
pub mod realtime;
pub(crate) mod signals;
pub(crate) mod watchdog;
