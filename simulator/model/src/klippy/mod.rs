// SPDX-License-Identifier: GPL-3.0-or-later
//! klippy's configuration language: how a part writes its sections of printer.cfg.

pub(crate) mod layout;
pub(crate) mod sections;
