// SPDX-License-Identifier: GPL-2.0-or-later
/*
 * kernel/irq/irq_sim.c as a module: upstream only builds it in.
 *
 * irq_to_desc() is not exported to modules; irq_get_irq_data() is, and leads to
 * the same descriptor.
 */
#include <linux/irq.h>
#include <linux/irqdesc.h>
#include <linux/module.h>

#define irq_to_desc(irq) irq_data_to_desc(irq_get_irq_data(irq))
#include "upstream/irq_sim.c"

MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("Simulated interrupts, for gpio-sim and iio_dummy");
