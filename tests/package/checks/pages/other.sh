# Any page without another check.
installed
page "$PAGE"
