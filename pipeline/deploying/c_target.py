"""The test of a filter on a Cortex-M4F that QEMU emulates (Arm's board MPS2, image AN386)."""

MACHINE = "mps2-an386"
TARGET_OPTIONS = (
    "-std=c99 -O2 -ffp-contract=off -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 "
    "--specs=rdimon.specs -DINSTRUCTIONS=instructions -T cortex_m4f.ld"
)


def target_lines(name: str, *, argument: str) -> list[str]:
    """Write the commands that build a filter's test for the target and run it in QEMU.

    Args:
        name: the filter's name.
        argument: the test's argument, which is the allowed difference from fuselog's own filter.
    """
    return [
        f"arm-none-eabi-gcc {TARGET_OPTIONS} cortex_m4f.c test_{name}.c {name}.c -lm -o test_{name}.elf",
        f"qemu-system-arm -M {MACHINE} -nographic -icount shift=0 -semihosting-config "
        f"enable=on,target=native,arg=test,arg={argument} -kernel test_{name}.elf",
    ]
