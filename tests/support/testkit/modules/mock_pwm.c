// SPDX-License-Identifier: GPL-2.0-or-later
/*
 * A PWM chip of eight channels which keeps the settings that it gets.
 *
 * In /sys/devices/platform/mock-pwm:
 *   fail      written: an errno with which each change fails, or 0
 *   outputs   one line per channel, "CHANNEL PERIOD_NS DUTY_NS ENABLED WRITES":
 *             what the pins would do, also if another program exported the channel
 *   history   the first changes since anything was written to it,
 *             "CHANNEL PERIOD_NS DUTY_NS ENABLED" each
 */
#include <linux/module.h>
#include <linux/platform_device.h>
#include <linux/pwm.h>

#define CHANNELS 8
#define CHANGES 32

struct change {
	unsigned int channel;
	struct pwm_state state;
};

struct mock_pwm {
	struct pwm_chip chip;
	struct pwm_state outputs[CHANNELS];
	unsigned int writes[CHANNELS];
	struct change history[CHANGES];
	unsigned int changes;
	int fail_errno;
};

static struct platform_device *mock_pwm_device;

static struct mock_pwm *to_mock_pwm(struct pwm_chip *chip)
{
	return container_of(chip, struct mock_pwm, chip);
}

static int mock_pwm_apply(struct pwm_chip *chip, struct pwm_device *pwm,
			  const struct pwm_state *state)
{
	struct mock_pwm *mock = to_mock_pwm(chip);
	int fail_errno = READ_ONCE(mock->fail_errno);

	if (fail_errno)
		return -fail_errno;
	mock->outputs[pwm->hwpwm] = *state;
	mock->writes[pwm->hwpwm]++;
	if (mock->changes < CHANGES) {
		mock->history[mock->changes].channel = pwm->hwpwm;
		mock->history[mock->changes++].state = *state;
	}
	return 0;
}

static int mock_pwm_get_state(struct pwm_chip *chip, struct pwm_device *pwm,
			      struct pwm_state *state)
{
	*state = to_mock_pwm(chip)->outputs[pwm->hwpwm];
	return 0;
}

static const struct pwm_ops mock_pwm_ops = {
	.apply = mock_pwm_apply,
	.get_state = mock_pwm_get_state,
	.owner = THIS_MODULE,
};

static ssize_t outputs_show(struct device *dev, struct device_attribute *attr,
			    char *buf)
{
	struct mock_pwm *mock = dev_get_drvdata(dev);
	ssize_t len = 0;
	int i;

	for (i = 0; i < CHANNELS; i++)
		len += sysfs_emit_at(buf, len, "%d %llu %llu %d %u\n", i,
				     mock->outputs[i].period,
				     mock->outputs[i].duty_cycle,
				     mock->outputs[i].enabled, mock->writes[i]);
	return len;
}
static DEVICE_ATTR_RO(outputs);

static ssize_t fail_store(struct device *dev, struct device_attribute *attr,
			  const char *buf, size_t len)
{
	struct mock_pwm *mock = dev_get_drvdata(dev);
	unsigned int fail_errno;
	int err = kstrtouint(buf, 0, &fail_errno);

	if (err)
		return err;
	if (fail_errno > MAX_ERRNO)
		return -EINVAL;
	WRITE_ONCE(mock->fail_errno, fail_errno);
	return len;
}
static DEVICE_ATTR_WO(fail);

static ssize_t history_show(struct device *dev, struct device_attribute *attr,
			    char *buf)
{
	struct mock_pwm *mock = dev_get_drvdata(dev);
	ssize_t len = 0;
	int i;

	for (i = 0; i < mock->changes; i++)
		len += sysfs_emit_at(buf, len, "%u %llu %llu %d\n",
				     mock->history[i].channel,
				     mock->history[i].state.period,
				     mock->history[i].state.duty_cycle,
				     mock->history[i].state.enabled);
	return len;
}

static ssize_t history_store(struct device *dev, struct device_attribute *attr,
			     const char *buf, size_t len)
{
	struct mock_pwm *mock = dev_get_drvdata(dev);

	mock->changes = 0;
	return len;
}
static DEVICE_ATTR_RW(history);

static struct attribute *mock_pwm_attrs[] = {
	&dev_attr_outputs.attr, &dev_attr_fail.attr, &dev_attr_history.attr,
	NULL
};
ATTRIBUTE_GROUPS(mock_pwm);

static int mock_pwm_probe(struct platform_device *pdev)
{
	struct mock_pwm *mock = devm_kzalloc(&pdev->dev, sizeof(*mock), GFP_KERNEL);

	if (!mock)
		return -ENOMEM;
	platform_set_drvdata(pdev, mock);
	mock->chip.dev = &pdev->dev;
	mock->chip.ops = &mock_pwm_ops;
	mock->chip.npwm = CHANNELS;
	return devm_pwmchip_add(&pdev->dev, &mock->chip);
}

static struct platform_driver mock_pwm_driver = {
	.probe = mock_pwm_probe,
	.driver = { .name = "mock-pwm", .dev_groups = mock_pwm_groups },
};

static int __init mock_pwm_init(void)
{
	int err = platform_driver_register(&mock_pwm_driver);

	if (err)
		return err;
	mock_pwm_device = platform_device_register_simple("mock-pwm", -1, NULL, 0);
	if (!IS_ERR(mock_pwm_device))
		return 0;
	platform_driver_unregister(&mock_pwm_driver);
	return PTR_ERR(mock_pwm_device);
}
module_init(mock_pwm_init);

static void __exit mock_pwm_exit(void)
{
	platform_device_unregister(mock_pwm_device);
	platform_driver_unregister(&mock_pwm_driver);
}
module_exit(mock_pwm_exit);

MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("PWM chip without pins");
