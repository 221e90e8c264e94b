/* SPDX-License-Identifier: GPL-2.0-or-later */
/*
 * What the mocked buses share: a record of the bytes that were sent, which a
 * test reads and clears, and failures and delays that a test asks for.
 */
#ifndef MOCK_BUS_H
#define MOCK_BUS_H

#include <linux/delay.h>
#include <linux/device.h>
#include <linux/kernel.h>
#include <linux/mutex.h>

struct mock_bus {
	struct mutex lock;
	/* One line per transfer. A full record drops everything older. */
	char sent[PAGE_SIZE / 2];
	size_t sent_len;
	int fail_errno;
	unsigned int fail_count;
	unsigned int delay_us;
};

static inline void mock_bus_record(struct mock_bus *bus, const char *what,
				   const u8 *bytes, size_t len)
{
	size_t cap = sizeof(bus->sent), i;

	if (bus->sent_len + strlen(what) + 3 * len + 2 > cap)
		bus->sent_len = 0;
	bus->sent_len += scnprintf(bus->sent + bus->sent_len,
				   cap - bus->sent_len, "%s", what);
	for (i = 0; i < len; i++)
		bus->sent_len += scnprintf(bus->sent + bus->sent_len,
					   cap - bus->sent_len, " %02x", bytes[i]);
	bus->sent_len += scnprintf(bus->sent + bus->sent_len,
				   cap - bus->sent_len, "\n");
}

/*
 * Sleeps and fails as the test asked: 0, or a negative errno. (msleep() would round up to the
 * kernel's ticks.)
 */
static inline int mock_bus_trouble(struct mock_bus *bus)
{
	unsigned int delay_us = READ_ONCE(bus->delay_us);
	int err = 0;

	if (delay_us)
		usleep_range(delay_us, delay_us);
	mutex_lock(&bus->lock);
	if (bus->fail_count) {
		bus->fail_count--;
		err = -bus->fail_errno;
	}
	mutex_unlock(&bus->lock);
	return err;
}

static ssize_t sent_show(struct device *dev, struct device_attribute *attr,
			 char *buf)
{
	struct mock_bus *bus = dev_get_drvdata(dev);
	ssize_t len;

	mutex_lock(&bus->lock);
	len = bus->sent_len;
	memcpy(buf, bus->sent, len);
	mutex_unlock(&bus->lock);
	return len;
}

/* Any write clears the record. */
static ssize_t sent_store(struct device *dev, struct device_attribute *attr,
			  const char *buf, size_t len)
{
	struct mock_bus *bus = dev_get_drvdata(dev);

	mutex_lock(&bus->lock);
	bus->sent_len = 0;
	mutex_unlock(&bus->lock);
	return len;
}
static DEVICE_ATTR_RW(sent);

/* "ERRNO COUNT": the next COUNT transfers fail with ERRNO. */
static ssize_t fail_store(struct device *dev, struct device_attribute *attr,
			  const char *buf, size_t len)
{
	struct mock_bus *bus = dev_get_drvdata(dev);
	unsigned int count;
	int err;

	if (sscanf(buf, "%d %u", &err, &count) != 2 || err < 0 || err > MAX_ERRNO)
		return -EINVAL;
	mutex_lock(&bus->lock);
	bus->fail_errno = err;
	bus->fail_count = err ? count : 0;
	mutex_unlock(&bus->lock);
	return len;
}
static DEVICE_ATTR_WO(fail);

static inline ssize_t mock_bus_delay(struct device *dev, const char *buf,
				     size_t len, unsigned int unit_us)
{
	struct mock_bus *bus = dev_get_drvdata(dev);
	unsigned int delay;
	int err = kstrtouint(buf, 0, &delay);

	if (err)
		return err;
	WRITE_ONCE(bus->delay_us, delay * unit_us);
	return len;
}

static ssize_t delay_ms_store(struct device *dev, struct device_attribute *attr,
			      const char *buf, size_t len)
{
	return mock_bus_delay(dev, buf, len, 1000);
}
static DEVICE_ATTR_WO(delay_ms);

static ssize_t delay_us_store(struct device *dev, struct device_attribute *attr,
			      const char *buf, size_t len)
{
	return mock_bus_delay(dev, buf, len, 1);
}
static DEVICE_ATTR_WO(delay_us);

#define MOCK_BUS_ATTRS \
	&dev_attr_sent.attr, &dev_attr_fail.attr, &dev_attr_delay_ms.attr, \
	&dev_attr_delay_us.attr

#endif
