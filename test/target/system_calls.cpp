// Stubs for system calls that newlib and GoogleTest need and semihosting does not provide.
#include <sys/stat.h>

#include <cerrno>
#include <cstddef>

extern "C" {

void _init() {}
void _fini() {}
void* __dso_handle = nullptr;

int mkdir(const char*, mode_t) {
  errno = ENOSYS;
  return -1;
}
int rmdir(const char*) {
  errno = ENOSYS;
  return -1;
}
char* getcwd(char* path, size_t size) {
  if (size < 2) return nullptr;
  path[0] = '/';
  path[1] = '\0';
  return path;
}
int getentropy(void*, size_t) {
  errno = ENOSYS;
  return -1;
}
}
