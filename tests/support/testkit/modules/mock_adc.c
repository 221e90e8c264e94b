// SPDX-License-Identifier: GPL-2.0-or-later
/*
 * IIO ADCs of several resolutions, eight channels each, whose readings a test
 * sets by writing in_voltageN_raw.
 *
 * In /sys/devices/platform/mock-adc.N, where N counts the kinds below:
 *   delay_ms   how long each reading takes
 *   fail       the errno of each reading, 0 for none
 * Writing "mock-adc.N" to /sys/bus/platform/drivers/mock-adc/unbind takes the
 * ADC away from under its users, to bind brings it back.
 */
#include <linux/delay.h>
#include <linux/iio/iio.h>
#include <linux/iio/kfifo_buf.h>
#include <linux/module.h>
#include <linux/platform_device.h>

#define CHANNELS 8
#define REFERENCE_MV 3300

static const struct mock_adc_kind {
	const char *name;
	char sign;
	u8 bits;
	/* Whether scan_elements has the resolution; many real ADCs have none. */
	bool has_scan_type;
} mock_adc_kinds[] = {
	/* The first one is iio:device0. */
	{ "mock-adc12", 'u', 12, true },
	{ "mock-adc8", 'u', 8, true },
	{ "mock-adc10", 'u', 10, true },
	{ "mock-adc16", 'u', 16, true },
	{ "mock-adc-s12", 's', 12, true },
	{ "mock-adc-s16", 's', 16, true },
	{ "mock-adc-plain", 'u', 12, false },
};

struct mock_adc {
	const struct mock_adc_kind *kind;
	struct iio_chan_spec channels[CHANNELS];
	int readings[CHANNELS];
	unsigned int delay_ms;
	int fail;
};

static struct platform_device *mock_adc_devices[ARRAY_SIZE(mock_adc_kinds)];

static int mock_adc_read_raw(struct iio_dev *iio, const struct iio_chan_spec *channel,
			     int *val, int *val2, long mask)
{
	struct mock_adc *adc = iio_priv(iio);
	unsigned int delay_ms = READ_ONCE(adc->delay_ms);
	int fail = READ_ONCE(adc->fail);

	switch (mask) {
	case IIO_CHAN_INFO_RAW:
		if (delay_ms)
			msleep(delay_ms);
		if (fail)
			return -fail;
		*val = READ_ONCE(adc->readings[channel->channel]);
		return IIO_VAL_INT;
	case IIO_CHAN_INFO_SCALE:
		*val = REFERENCE_MV;
		*val2 = adc->kind->bits - (adc->kind->sign == 's');
		return IIO_VAL_FRACTIONAL_LOG2;
	default:
		return -EINVAL;
	}
}

static int mock_adc_write_raw(struct iio_dev *iio, const struct iio_chan_spec *channel,
			      int val, int val2, long mask)
{
	struct mock_adc *adc = iio_priv(iio);

	if (mask != IIO_CHAN_INFO_RAW)
		return -EINVAL;
	WRITE_ONCE(adc->readings[channel->channel], val);
	return 0;
}

static const struct iio_info mock_adc_info = {
	.read_raw = mock_adc_read_raw,
	.write_raw = mock_adc_write_raw,
};

static ssize_t delay_ms_store(struct device *dev, struct device_attribute *attr,
			      const char *buf, size_t len)
{
	struct mock_adc *adc = iio_priv(dev_get_drvdata(dev));
	unsigned int delay_ms;
	int err = kstrtouint(buf, 0, &delay_ms);

	if (err)
		return err;
	WRITE_ONCE(adc->delay_ms, delay_ms);
	return len;
}
static DEVICE_ATTR_WO(delay_ms);

static ssize_t fail_store(struct device *dev, struct device_attribute *attr,
			  const char *buf, size_t len)
{
	struct mock_adc *adc = iio_priv(dev_get_drvdata(dev));
	unsigned int fail;
	int err = kstrtouint(buf, 0, &fail);

	if (err)
		return err;
	if (fail > MAX_ERRNO)
		return -EINVAL;
	WRITE_ONCE(adc->fail, fail);
	return len;
}
static DEVICE_ATTR_WO(fail);

static struct attribute *mock_adc_attrs[] = {
	&dev_attr_delay_ms.attr, &dev_attr_fail.attr, NULL
};
ATTRIBUTE_GROUPS(mock_adc);

static int mock_adc_probe(struct platform_device *pdev)
{
	const struct mock_adc_kind *kind = &mock_adc_kinds[pdev->id];
	struct mock_adc *adc;
	struct iio_dev *iio;
	int err, i;

	iio = devm_iio_device_alloc(&pdev->dev, sizeof(*adc));
	if (!iio)
		return -ENOMEM;
	platform_set_drvdata(pdev, iio);
	adc = iio_priv(iio);
	adc->kind = kind;
	for (i = 0; i < CHANNELS; i++) {
		struct iio_chan_spec *channel = &adc->channels[i];

		channel->type = IIO_VOLTAGE;
		channel->indexed = 1;
		channel->channel = i;
		channel->info_mask_separate = BIT(IIO_CHAN_INFO_RAW);
		channel->info_mask_shared_by_type = BIT(IIO_CHAN_INFO_SCALE);
		channel->scan_index = kind->has_scan_type ? i : -1;
		channel->scan_type.sign = kind->sign;
		channel->scan_type.realbits = kind->bits;
		channel->scan_type.storagebits = kind->bits > 8 ? 16 : 8;
		channel->scan_type.endianness = IIO_LE;
	}
	iio->name = kind->name;
	iio->info = &mock_adc_info;
	iio->modes = INDIO_DIRECT_MODE;
	iio->channels = adc->channels;
	iio->num_channels = CHANNELS;
	if (kind->has_scan_type) {
		err = devm_iio_kfifo_buffer_setup(&pdev->dev, iio, NULL);
		if (err)
			return err;
	}
	return devm_iio_device_register(&pdev->dev, iio);
}

static struct platform_driver mock_adc_driver = {
	.probe = mock_adc_probe,
	.driver = { .name = "mock-adc", .dev_groups = mock_adc_groups },
};

static void mock_adc_unregister(int count)
{
	while (count--)
		platform_device_unregister(mock_adc_devices[count]);
	platform_driver_unregister(&mock_adc_driver);
}

static int __init mock_adc_init(void)
{
	int i, err = platform_driver_register(&mock_adc_driver);

	if (err)
		return err;
	for (i = 0; i < ARRAY_SIZE(mock_adc_kinds); i++) {
		mock_adc_devices[i] =
			platform_device_register_simple("mock-adc", i, NULL, 0);
		if (IS_ERR(mock_adc_devices[i])) {
			err = PTR_ERR(mock_adc_devices[i]);
			mock_adc_unregister(i);
			return err;
		}
	}
	return 0;
}
module_init(mock_adc_init);

static void __exit mock_adc_exit(void)
{
	mock_adc_unregister(ARRAY_SIZE(mock_adc_kinds));
}
module_exit(mock_adc_exit);

MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("IIO ADCs whose readings are written");
