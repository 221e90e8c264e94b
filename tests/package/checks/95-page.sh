# Any page that no other check tries.
installed
page "$PAGE"
