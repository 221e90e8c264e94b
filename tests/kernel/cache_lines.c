// SPDX-License-Identifier: GPL-3.0-or-later
// A plugin of QEMU. For each edge on a line of gpio-sim it counts the cache lines that the processor used since it
// woke from idle: distinct pieces of 64 bytes, by their virtual addresses, until the driver's first instruction.
//
// It appends a line to the file of its argument `into=` for each edge: the lines of instructions and of data that the
// kernel used, those of programs, and how many of all the last system call used first. It is the one that writes the
// edge.
//
// QEMU's headers are not in Debian's packages. These declarations are from its documentation of plugins.

#include <inttypes.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

struct qemu_plugin_tb;
struct qemu_plugin_insn;
enum { NO_REGISTERS = 0, READS_AND_WRITES = 3 };
void qemu_plugin_register_vcpu_tb_trans_cb(uint64_t id, void (*)(uint64_t id, struct qemu_plugin_tb *));
void qemu_plugin_register_vcpu_insn_exec_cb(struct qemu_plugin_insn *, void (*)(unsigned cpu, void *), int, void *);
void qemu_plugin_register_vcpu_mem_cb(struct qemu_plugin_insn *, void (*)(unsigned cpu, uint32_t, uint64_t, void *),
				      int, int, void *);
size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb *);
struct qemu_plugin_insn *qemu_plugin_tb_get_insn(const struct qemu_plugin_tb *, size_t);
uint64_t qemu_plugin_insn_vaddr(const struct qemu_plugin_insn *);
size_t qemu_plugin_insn_size(const struct qemu_plugin_insn *);
char *qemu_plugin_insn_disas(const struct qemu_plugin_insn *);
unsigned qemu_plugin_mem_size_shift(uint32_t);

// The functions above are the same in all versions. QEMU 7 and 8 take version 1, and QEMU 9 and later take 2.
EXPORT int qemu_plugin_version = VERSION;

// Linux keeps modules from here on. Of them only gpio-sim runs between a wake-up and an edge.
static const uint64_t MODULES = 0xffffffffc0000000;
static const uint64_t KERNEL = 0xffff800000000000;
enum { LINE_SHIFT = 6, LINE_MASK = 63, SLOTS = 1 << 14 };

enum kind { KERNEL_CODE, KERNEL_DATA, PROGRAM_CODE, PROGRAM_DATA, KINDS };

static FILE *into;
// Whether the processor has been woken and no edge has come since.
static bool counts;
// Whose instruction is the last one.
static bool in_kernel;
static unsigned used[KINDS];
static unsigned used_before_call;
// A set of lines. A slot is empty if it was filled before the last wake-up.
static struct {
	uint64_t line;
	uint64_t wakeup;
} slots[SLOTS];
static uint64_t wakeup;

static unsigned used_of_all(void)
{
	unsigned all = 0;
	for (int kind = 0; kind < KINDS; kind++)
		all += used[kind];
	return all;
}

static void use(uint64_t line, enum kind kind)
{
	size_t at = line * 0x9e3779b97f4a7c15 >> 50;
	while (slots[at].wakeup == wakeup && slots[at].line != line)
		at = (at + 1) % SLOTS;
	if (slots[at].wakeup == wakeup)
		return;
	slots[at].line = line;
	slots[at].wakeup = wakeup;
	used[kind]++;
	// The processor works on something else.
	if (used_of_all() > SLOTS / 2)
		counts = false;
}

// Before an instruction that waits for an interrupt.
static void idle(unsigned cpu, void *unused)
{
	(void)cpu, (void)unused;
	wakeup++;
	memset(used, 0, sizeof used);
	used_before_call = 0;
	counts = true;
}

static void call(unsigned cpu, void *unused)
{
	(void)cpu, (void)unused;
	used_before_call = used_of_all();
}

static void execute(unsigned cpu, void *address)
{
	(void)cpu;
	uint64_t at = (uintptr_t)address;
	if (!counts)
		return;
	if (at >= MODULES) {
		counts = false;
		for (int kind = 0; kind < KINDS; kind++)
			fprintf(into, "%u ", used[kind]);
		fprintf(into, "%u\n", used_of_all() - used_before_call);
		fflush(into);
		return;
	}
	in_kernel = at >= KERNEL;
	use(at >> LINE_SHIFT, in_kernel ? KERNEL_CODE : PROGRAM_CODE);
}

static void access(unsigned cpu, uint32_t info, uint64_t at, void *unused)
{
	(void)cpu, (void)unused;
	if (!counts)
		return;
	uint64_t last = at + (1u << qemu_plugin_mem_size_shift(info)) - 1;
	for (uint64_t line = at >> LINE_SHIFT; line <= last >> LINE_SHIFT; line++)
		use(line, in_kernel ? KERNEL_DATA : PROGRAM_DATA);
}

static void translate(uint64_t id, struct qemu_plugin_tb *block)
{
	(void)id;
	uint64_t line = UINT64_MAX;
	for (size_t n = 0; n < qemu_plugin_tb_n_insns(block); n++) {
		struct qemu_plugin_insn *instruction = qemu_plugin_tb_get_insn(block, n);
		uint64_t at = qemu_plugin_insn_vaddr(instruction), size = qemu_plugin_insn_size(instruction);
		// An instruction may be in two lines. Once for each line of the block is enough.
		for (uint64_t byte = at; byte <= at + size - 1; byte = (byte | LINE_MASK) + 1) {
			if (byte >> LINE_SHIFT == line)
				continue;
			line = byte >> LINE_SHIFT;
			qemu_plugin_register_vcpu_insn_exec_cb(instruction, execute, NO_REGISTERS,
							       (void *)(uintptr_t)byte);
		}
		qemu_plugin_register_vcpu_mem_cb(instruction, access, NO_REGISTERS, READS_AND_WRITES, NULL);
		if (size > 2)
			continue;
		char *text = qemu_plugin_insn_disas(instruction);
		if (strncmp(text, "hlt", 3) == 0)
			qemu_plugin_register_vcpu_insn_exec_cb(instruction, idle, NO_REGISTERS, NULL);
		if (strncmp(text, "syscall", 7) == 0)
			qemu_plugin_register_vcpu_insn_exec_cb(instruction, call, NO_REGISTERS, NULL);
		free(text);
	}
}

EXPORT int qemu_plugin_install(uint64_t id, const void *info, int argc, char **argv)
{
	(void)info;
	for (int n = 0; n < argc; n++)
		if (strncmp(argv[n], "into=", 5) == 0)
			into = fopen(argv[n] + 5, "w");
	if (!into) {
		fprintf(stderr, "cache_lines: into=FILE must name a file that can be written\n");
		return 1;
	}
	qemu_plugin_register_vcpu_tb_trans_cb(id, translate);
	return 0;
}
