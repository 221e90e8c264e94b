bare
page docs/guide/install.md
