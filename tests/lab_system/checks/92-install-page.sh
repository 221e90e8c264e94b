bare
page docs/install.md
